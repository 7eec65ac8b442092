"""Cost of one environment, measured in its own process; `benchmarks/simulate.py` runs it.

`python benchmarks/simulate_one.py '{"environment": "push_cube", "size": null, …}'` prints a line of
JSON. The name "gymnasium" means Gymnasium's own Reacher-v5, drawn by MuJoCo with OpenGL.
"""

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.data.shards import write_shard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.environment import Environment
from acwm_core.env.episode import EpisodeSpec

GYMNASIUM = "gymnasium"


class Stopwatch:
    """Adds up the processor time spent in the functions it wraps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, timed."""

        def timed(*args: Any) -> Any:
            start = time.process_time()
            try:
                return function(*args)
            finally:
                self.seconds += time.process_time() - start

        return timed


def seconds(function: Callable[[], Any]) -> float:
    """Processor time of one call, summed over threads."""
    start = time.process_time()
    function()
    return time.process_time() - start


def workload() -> float:
    """Sorts of a hundred thousand numbers per second: the current speed of this core."""
    values = np.random.default_rng(0).normal(size=100_000)
    return 1 / float(np.median([seconds(lambda: np.sort(values)) for _ in range(50)]))


def episode_costs(env: Environment, drawing: Stopwatch, spec: EpisodeSpec) -> tuple[float, ...]:
    """Processor seconds of one episode: physics with the policy, drawing, writing its shard."""
    drawing.seconds = 0.0
    start = time.process_time()
    episode = simulate(env, spec)
    simulated = time.process_time() - start
    with tempfile.TemporaryDirectory() as folder:
        shard = Path(folder) / "shard.tar"
        written = seconds(lambda: write_shard(shard, [episode], env.card.fps, {}))
    return simulated - drawing.seconds, drawing.seconds, written


def measure(name: str, size: int | None, episodes: int, repeats: int) -> dict[str, Any]:
    """Mean costs of an episode in seconds, in and out of distribution, and peak memory."""
    env = make_environment(name, {} if size is None else {"size": size})
    drawing = Stopwatch()
    warm_up(env)
    env._render = drawing.wrap(env._render)
    costs: dict[str, list[float]] = {}
    for split, count in (("train", episodes), ("ood_test", min(episodes, 2))):
        specs = [EpisodeSpec(name, split, index) for index in range(count)]
        best = [
            min((episode_costs(env, drawing, spec) for _ in range(repeats)), key=sum)
            for spec in specs
        ]
        costs[split] = np.mean(best, axis=0).tolist()
    return {
        "size": env.frame_size,
        "frames": env.card.horizon,
        "costs": costs["train"],
        "ood_costs": costs["ood_test"],
        "episodes": dict(env.card.episodes),
        "variants": env.card.variants,
        "memory": _peak_memory(),
    }


def warm_up(env: Environment) -> None:
    """Take a few steps, which compile the kernels and draw the static parts."""
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.clip(np.zeros(env.card.action.size), env.card.action.low, env.card.action.high))


def measure_gymnasium(size: int | None, episodes: int, repeats: int) -> dict[str, Any]:
    """Like `measure`, for Gymnasium's Reacher-v5; its frames are not written."""
    import gymnasium

    side = size or 240
    env = gymnasium.make("Reacher-v5", render_mode="rgb_array", width=side, height=side)
    drawing, frames = Stopwatch(), 50
    draw = drawing.wrap(env.render)

    def play(seed: int) -> tuple[float, float]:
        drawing.seconds = 0.0
        start = time.process_time()
        env.reset(seed=seed)
        draw()
        for _ in range(frames - 1):
            env.step(env.action_space.sample())
            draw()
        return time.process_time() - start - drawing.seconds, drawing.seconds

    play(0)
    best = [min((play(seed) for _ in range(repeats)), key=sum) for seed in range(episodes)]
    costs = [*np.mean(best, axis=0).tolist(), 0.0]
    memory = _peak_memory()
    return {"size": (side, side), "frames": frames, "costs": costs, "memory": memory}


def _peak_memory() -> float:
    """Peak memory of this process until now, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure what the first argument asks for, on one core, and print it."""
    wanted = json.loads(sys.argv[1])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {wanted.pop("core")})
    unit = workload()
    if wanted["environment"] == GYMNASIUM:
        del wanted["environment"]
        found = measure_gymnasium(**wanted)
    else:
        found = measure(wanted.pop("environment"), **wanted)
    print(json.dumps({**found, "sorts": max(unit, workload())}))


if __name__ == "__main__":
    main()
