"""How often scripted solutions solve the tasks, with pictures: the table of docs/findings/tasks.md.

python benchmarks/tasks.py --seeds 50                       # all tasks, from all environments
python benchmarks/tasks.py push_cube.place --seeds 10 --pictures docs/tasks
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.stats import binomtest

from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.plugins import catalog

SEED = 22
"""Seed of the episodes, which are number 0, 1, … of `ind_test`."""

VARIANTS = ("push_cube_4cube", "push_cube_two_pushers", "cloth_move_8d", "pendulum")
"""Environments that are left out by default."""


def solve(env: TaskEnvironment, index: int) -> dict[str, Any]:
    """Play the scripted solution of one episode.

    Returns:
        ``success``, ``failed``, ``steps``, ``start`` and ``end`` (distances), and ``pictures``: the
        frames of start, goal and end.
    """
    spec = EpisodeSpec(env.environment.card.name, "ind_test", index, SEED)
    first, info = env.reset(options={"spec": spec})
    act = env.task.solution(env.environment, env.goal, spec.rng("solution"))
    assert act is not None, f"{env.task.name} has no solution"
    start, frame, over, steps = info["distance"], first, False, 0
    while not over:
        frame, _, success, truncated, info = env.step(np.asarray(act(), np.float32))
        over, steps = success or truncated, steps + 1
    kept = {name: info[name] for name in ("success", "failed")}
    pictures = [first, env.goal.frame, frame]
    return {**kept, "steps": steps, "start": start, "end": info["distance"], "pictures": pictures}


def row(name: str, task: Any, runs: Sequence[dict[str, Any]]) -> str:
    """A row of the table in Markdown."""
    solved = [run for run in runs if run["success"]]
    interval = binomtest(len(solved), len(runs)).proportion_ci(0.95, "exact")
    start, end = (np.mean([run[when] for run in runs]) for when in ("start", "end"))
    steps = f"{np.mean([run['steps'] for run in solved]):.0f}" if solved else "–"
    unit = f" {task.unit}" if task.unit else ""
    share = f"{len(solved) / len(runs):.0%} ({interval.low:.0%} to {interval.high:.0%})"
    distance = f"{start:.3f} → {end:.3f}{unit}"
    return f"| `{name}` | {len(solved)} of {len(runs)} | {share} | {distance} | {steps} |"


def sheet(pictures: Sequence[Sequence[NDArray[np.uint8]]], height: int = 96) -> Image.Image:
    """Pictures of start, goal and end side by side, one row per episode."""
    rows = [np.concatenate([_scaled(each, height) for each in row], 1) for row in pictures]
    return Image.fromarray(np.concatenate(rows))


def _scaled(frame: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    width = round(height * frame.shape[1] / frame.shape[0])
    small = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
    return np.pad(np.asarray(small), ((1, 1), (1, 1), (0, 0)), constant_values=255)


def main() -> None:
    """Solve the tasks, print the table, and write results and pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tasks", nargs="*", metavar="ENVIRONMENT.TASK")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--size", type=int, default=64, help="frame height")
    parser.add_argument("--pictures", type=Path, help="folder for ENVIRONMENT.TASK.jpg")
    parser.add_argument("--shown", type=int, default=2, help="episodes in a picture")
    parser.add_argument("--out", type=Path, help="a JSON file for every episode's result")
    args = parser.parse_args()
    every = [
        f"{component.name}.{task}"
        for component in catalog().registry("environment")
        for task in component.tasks
        if component.name not in VARIANTS
    ]
    results: dict[str, list[dict[str, Any]]] = {}
    print("| Task | Solved | Share (95 % interval) | Mean distance | Steps |", flush=True)
    print("| --- | --- | --- | --- | --- |", flush=True)
    for name in args.tasks or every:
        environment, _, task = name.partition(".")
        component = catalog().component("environment", environment)
        env = TaskEnvironment(component.create(size=args.size), component.load_task(task))
        runs = [solve(env, index) for index in range(args.seeds)]
        env.close()
        print(row(name, env.task, runs), flush=True)
        if args.pictures:
            pictures = [run["pictures"] for run in runs[: args.shown]]
            sheet(pictures).save(args.pictures / f"{name}.jpg", quality=88)
        results[name] = [{k: v for k, v in run.items() if k != "pictures"} for run in runs]
        if args.out:
            args.out.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
