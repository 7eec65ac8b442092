"""`acwm demo`: from a simulator to an evaluated world model, in one folder."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import OUT_FOLDER
from acwm_core.plugins import catalog
from acwm_core.training.threads import wait_without_spinning
from acwm_report.terminal import print_summary

if TYPE_CHECKING:
    from acwm_core.env.episode import Split
    from acwm_core.recipe import Recipe

EPISODE_COUNTS: Mapping[Split, int] = {"train": 3200, "ind_test": 64, "ood_test": 64}
QUICK_EPISODE_COUNTS: Mapping[Split, int] = {"train": 16, "ind_test": 4, "ood_test": 4}

ALIKE = ("frames", "episodes", "counterfactual_episodes", "steps")
"""Settings of the evaluation that the shipped model takes from the demo."""


@click.command()
@click.option("--out", type=OUT_FOLDER, help="Folder for all files.")
@click.option("--quick", is_flag=True, help="A test of about a minute; the model learns nothing.")
def demo(out: Path | None, quick: bool) -> None:
    """Simulate, train, evaluate and report, at once.

    Takes ten to twenty minutes without a GPU: simulates a small dataset, trains a world model,
    evaluates it and writes a report in runs/demo (with --quick, runs/demo_quick). If it is
    interrupted, run the same command again to continue.
    """
    from acwm_core.recipe import compose

    write_report = catalog().component("command", "report").load()
    folder = out or Path("runs", "demo_quick" if quick else "demo")
    episodes = QUICK_EPISODE_COUNTS if quick else EPISODE_COUNTS
    data, run, shipped, report = (folder / n for n in ("data", "run", "shipped", "report.html"))
    recipe = compose("demo", [*(["+quick"] if quick else []), f"data.path={data}"])
    total, steps = sum(episodes.values()), recipe.trainer["max_steps"]
    _step(1, f"simulating {total} episodes", lambda: _generate(recipe, data, episodes))
    _step(2, f"training for {steps} steps", lambda: _fit(recipe, run))
    _step(3, "predicting every test clip", lambda: _evaluate(run))
    _step(4, "predicting them by the model that ships", lambda: _evaluate_shipped(run, shipped))
    _step(5, "writing the report", lambda: _report((run, shipped), write_report, report))


def _step(number: int, what: str, work: Callable[[], bool]) -> None:
    click.echo(f"[{number}/5] {what}", err=True)
    started = time.monotonic()
    done = work()
    note = f"took {time.monotonic() - started:.0f} s" if done else "was done before"
    click.echo(f"[{number}/5] {note}", err=True)


def _generate(recipe: Recipe, data: Path, episodes: Mapping[Split, int]) -> bool:
    from acwm_core.data.generate import generate

    assert recipe.env is not None
    # Called even if all data exists, because it checks that the data matches the request.
    generate(recipe.env.name, data, episodes=episodes, size=64)
    return True


def _fit(recipe: Recipe, run: Path) -> bool:
    wait_without_spinning()
    from acwm_core.training.fit import fit
    from acwm_core.training.run import read_metadata
    from acwm_core.training.run_folder import RunFolder
    from acwm_core.training.signals import StoppedEarly

    folder = RunFolder(run)
    finished = recipe.trainer["max_steps"]
    if folder.weights.exists() and read_metadata(folder.weights)["step"] >= finished:
        return False
    if run.exists() and not folder.last_checkpoint.exists():  # stopped too early to resume
        shutil.rmtree(run)
    try:
        fit(recipe, run, resume=run if run.exists() else None)
    except StoppedEarly as stopped:
        what = str(stopped).rpartition("; ")[0]
        again = "run the same command again to continue"
        raise StoppedEarly(f"{what}; {again}", stopped.exit_code) from None
    return True


def _evaluate(run: Path) -> bool:
    from acwm_core.evaluation.evaluate import evaluate_run
    from acwm_core.training.run_folder import RunFolder

    if _is_newer(run, RunFolder(run).weights):
        return False
    evaluate_run(run)
    return True


def _evaluate_shipped(run: Path, out: Path) -> bool:
    """Evaluate the shipped model of this world on the same clips."""
    from acwm_core.evaluation.evaluate import evaluate_run
    from acwm_core.training.run import load_run
    from acwm_core.training.run_folder import RunFolder

    if _is_newer(out, RunFolder(run).weights):
        return False
    recipe = load_run(run).recipe
    assert recipe.env is not None
    words = [f"evaluation.{k}={json.dumps(v)}" for k, v in recipe.evaluation.items() if k in ALIKE]
    evaluate_run(recipe.env.name, data=recipe.data["path"], overrides=words, out=out)
    return True


def _is_newer(run: Path, weights: Path) -> bool:
    from acwm_core.evaluation.results import FOLDER, SUMMARY

    summary = run / FOLDER / SUMMARY
    return summary.exists() and summary.stat().st_mtime > weights.stat().st_mtime


def _report(runs: tuple[Path, ...], write: click.Command, report: Path) -> bool:
    from acwm_core.evaluation.results import Summary

    print_summary(Summary.read(runs[0]))
    click.echo("report: ", nl=False)  # the command prints the path
    click.get_current_context().invoke(write, runs=runs, out=report)
    return True
