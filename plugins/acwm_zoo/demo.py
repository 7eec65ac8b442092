"""`acwm demo`: from a simulator to an evaluated world model, in one folder."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from acwm_core.cli.arguments import OUT_FOLDER
from acwm_core.plugins import catalog
from acwm_core.training.threads import wait_without_spinning
from acwm_report.terminal import print_summary

if TYPE_CHECKING:
    from acwm_core.env.episode import Split
    from acwm_core.recipe import Recipe

TRAINING: Mapping[Split, int] = {"train": 1280}
TESTS: Mapping[Split, int] = {"ind_test": 32, "ood_test": 32}
QUICK_TRAINING: Mapping[Split, int] = {"train": 16}
QUICK_TESTS: Mapping[Split, int] = {"ind_test": 4, "ood_test": 4}

ALIKE = ("frames", "episodes", "counterfactual_episodes", "steps")
"""Settings of the evaluation that the shipped model takes from the demo."""


class Step(NamedTuple):
    """A step of the demo.

    Attributes:
        what: what it does, for the terminal.
        seconds: how long it takes on two idle cores.
        work: does it, unless it is already done; returns whether it did.
    """

    what: str
    seconds: float
    work: Callable[[], bool]


@click.command()
@click.option("--out", type=OUT_FOLDER, help="Folder for all files.")
@click.option("--quick", is_flag=True, help="A test of about a minute; the model learns nothing.")
def demo(out: Path | None, quick: bool) -> None:
    """Simulate, train, evaluate and report in one go.

    Takes about ten minutes on two CPU cores: compares the trained model that ships with the
    simulator, then simulates a small dataset, trains a world model, evaluates it and adds it to
    the report in runs/demo (with --quick, runs/demo_quick). If it is interrupted, run the same
    command again to continue.
    """
    from acwm_core.recipe import compose
    from acwm_report.page import write_report

    catalog().component("command", "report")  # says so now if it is missing
    folder = out or Path("runs", "demo_quick" if quick else "demo")
    training, tests = (QUICK_TRAINING, QUICK_TESTS) if quick else (TRAINING, TESTS)
    data, run, shipped, report = (folder / n for n in ("data", "run", "shipped", "report.html"))
    rehearsal = ["+quick", "objective.motion_steps=5"] if quick else []
    recipe = compose("demo", [*rehearsal, f"data.path={data}"])
    episodes, held_out = sum(training.values()), sum(tests.values())

    def first_page() -> bool:
        if report.exists():
            return False
        write_report([shipped], report)
        click.echo(f"open {report} now; your own model will be added to it", err=True)
        return True

    def both() -> bool:
        write_report([run, shipped], report)
        return True

    steps = recipe.trainer["max_steps"]
    _work_through(
        Step(f"simulating {held_out} test episodes", 12, lambda: _generate(recipe, data, tests)),
        Step("predicting them by the model that ships", 65, lambda: _shipped(recipe, shipped)),
        Step("writing the first report", 2, first_page),
        Step(f"simulating {episodes} episodes", 90, lambda: _generate(recipe, data, training)),
        Step(f"training for {steps} steps", 290, lambda: _fit(recipe, run)),
        Step("predicting the test episodes", 40, lambda: _evaluate(run)),
        Step("writing the report", 4, both),
    )
    from acwm_core.evaluation.results import Summary

    print_summary(Summary.read(run))
    click.echo(f"report: {report}")


def _work_through(*steps: Step) -> None:
    """Do the steps in order, and say before each about how long all that are left will take."""
    spent = expected = 0.0
    for number, step in enumerate(steps):
        pace = spent / expected if expected else 1.0
        minutes = max(1, round(pace * sum(each.seconds for each in steps[number:]) / 60))
        place = f"[{number + 1}/{len(steps)}]"
        click.echo(f"{place} {step.what}; about {minutes} min left", err=True)
        started = time.monotonic()
        done = step.work()
        seconds = time.monotonic() - started
        click.echo(f"{place} {f'took {seconds:.0f} s' if done else 'already done'}", err=True)
        if done:
            spent, expected = spent + seconds, expected + step.seconds


def _generate(recipe: Recipe, data: Path, episodes: Mapping[Split, int]) -> bool:
    from acwm_core.data.card import CARD, DatasetCard
    from acwm_core.data.generate import generate

    assert recipe.env is not None
    finished = DatasetCard.read(data).checksums if (data / CARD).exists() else {}
    # Called even if all data exists, because it checks that the data matches the request.
    generate(recipe.env.name, data, episodes=episodes, size=64)
    return not episodes.keys() <= finished.keys()


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
    from acwm_core.training.run_folder import RunFolder
    from acwm_interventions.evaluate import evaluate_run

    if _is_newer(run, RunFolder(run).weights):
        return False
    evaluate_run(run)
    return True


def _shipped(recipe: Recipe, out: Path) -> bool:
    """Evaluate the shipped model of this world on the same clips."""
    from acwm_core.evaluation.results import FOLDER, SUMMARY
    from acwm_interventions.evaluate import evaluate_run

    if (out / FOLDER / SUMMARY).exists():
        return False
    assert recipe.env is not None
    words = [f"evaluation.{k}={json.dumps(v)}" for k, v in recipe.evaluation.items() if k in ALIKE]
    evaluate_run(recipe.env.name, data=recipe.data["path"], overrides=words, out=out)
    return True


def _is_newer(run: Path, weights: Path) -> bool:
    from acwm_core.evaluation.results import FOLDER, SUMMARY

    summary = run / FOLDER / SUMMARY
    return summary.exists() and summary.stat().st_mtime > weights.stat().st_mtime
