"""How good the recipe `small` becomes with how many episodes (docs/findings/data-amount.md).

    python benchmarks/data_amount.py --out runs/amounts    # rows of plugins/acwm_report/needs.yaml
    python benchmarks/data_amount.py --out runs/amounts --only reacher --started push_rope

A world's episodes are simulated once, and each training takes a fixed part of them. Scores are of
test episodes: PSNR of 64 whole ones, response of the first 37 frames of 16. With ``--started``,
trainings begin with the weights of that trained model and have its size. What is finished is kept
in ``--out``: after an interruption the same command continues. On one core a training takes five to
ten minutes.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import click
import yaml

from acwm_core.evaluation.results import Summary

WORLDS = ("push_cube", "reacher", "robot_arm")
AMOUNTS = (32, 128, 512, 2048)
EVALUATION = (
    "evaluation.metrics=[psnr]",
    "evaluation.splits=[ind_test]",
    "evaluation.noise_floor_episodes=0",
    "evaluation.perturbed_episodes=0",
    "evaluation.videos=0",
)
MARK = "evaluated"
"""File in a run folder that is finished."""


def acwm(*words: object) -> None:
    """Run a command of acwm in one thread."""
    command = [sys.executable, "-m", "acwm_core.cli", *map(str, words)]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def measure(out: Path, world: str, amount: int, started: str | None) -> dict[str, float]:
    """Train on `amount` episodes and evaluate; returns PSNR in dB and response."""
    data, run = out / "data" / world, out / f"{world}-{amount}-{started or 'small'}"
    if not (run / MARK).exists():
        words = [f"data.path={data}", f"data.fraction={amount / AMOUNTS[-1]}", "resume=auto"]
        if started:
            words += ["model.channels=96", f"training.init_from={started}"]
        acwm("fit", "small", *words, "training.validation_rollouts=0", "--out", run)
        acwm("evaluate", run, "--data", data, "--overwrite", *EVALUATION)
        (run / MARK).touch()
    split = Summary.read(run).splits["ind_test"]
    assert split.counterfactual, "these worlds have counterfactuals"
    scores = split.scores.rows["model"] | split.counterfactual.rows["model"]
    return {name: round(scores[name].value or 0.0, 3) for name in ("psnr", "response")}


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Data and runs.")
@click.option("--only", multiple=True, type=click.Choice(WORLDS), help="Only this world.")
@click.option("--started", help="A trained model to start from; its actions must be as many.")
def main(out: Path, only: tuple[str, ...], started: str | None) -> None:
    """Measure, and print the rows of needs.yaml."""
    for world in only or WORLDS:
        episodes = f"{AMOUNTS[-1]},64,64"
        acwm("generate", world, "--size", 64, "--episodes", episodes, "--out", out / "data" / world)
        for amount in AMOUNTS:
            found = measure(out, world, amount, started)
            if started:
                found = {f"{name}_started": value for name, value in found.items()}
            click.echo(yaml.safe_dump([{"world": world, "episodes": amount, **found}]), nl=False)


if __name__ == "__main__":
    main()
