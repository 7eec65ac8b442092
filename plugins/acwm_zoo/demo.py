"""`acwm demo`: from a simulator to an evaluated world model, in one folder."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
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

EPISODES = 1280
"""Episodes to train on."""

TESTS: Mapping[Split, int] = {"ind_test": 32, "ood_test": 32}
QUICK_TESTS: Mapping[Split, int] = {"ind_test": 4, "ood_test": 4}

SECONDS = 690
"""How long it should take: on a machine that is slower than the one of `Step` it is smaller."""

SHARES = (1.0, 0.75, 0.5, 0.35)
"""Shares of the episodes and of the training steps that it may have."""

SHARE = "share.json"
"""File that keeps the share, so that a continued demo goes on as it began."""

ALIKE = ("frames", "episodes", "counterfactual_episodes", "steps")
"""Settings of the evaluation that the shipped model takes from the demo."""

SIMULATING, TRAINING, CLOSING = 90, 290, 44
"""Seconds of simulating the training episodes, of the training, and of what follows; see `Step`."""


class Step(NamedTuple):
    """A step of the demo.

    Attributes:
        what: what it does, for the terminal.
        seconds: how long it takes on two idle cores with AVX-512.
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
    the report in runs/demo (with --quick, runs/demo_quick). On a slow machine it simulates less
    and trains for fewer steps. If it is interrupted, run the same command again to continue.
    """
    from acwm_core.evaluation.results import Summary
    from acwm_core.recipe import compose
    from acwm_report.page import write_report

    catalog().component("command", "report")  # says so now if it is missing
    folder = out or Path("runs", "demo_quick" if quick else "demo")
    tests = QUICK_TESTS if quick else TESTS
    data, run, shipped, report = (folder / n for n in ("data", "run", "shipped", "report.html"))
    rehearsal = ["+quick", "objective.motion_steps=5"] if quick else []
    recipe = compose("demo", [*rehearsal, f"data.path={data}"])
    held_out = sum(tests.values())

    def first_page() -> bool:
        if report.exists():
            return False
        write_report([shipped], report)
        click.echo(f"open {report} now; your own model will be added to it", err=True)
        return True

    def both() -> bool:
        write_report([run, shipped], report)
        return True

    progress = Progress(7)
    opening = (
        Step(f"simulating {held_out} test episodes", 12, lambda: _generate(recipe, data, tests)),
        Step("predicting them by the model that ships", 65, lambda: _shipped(recipe, shipped)),
        Step("writing the first report", 2, first_page),
    )
    progress.work(opening, later=SIMULATING + TRAINING + CLOSING)
    share = 1.0 if quick else share_of_time(folder, progress)
    training: Mapping[Split, int] = {"train": 16 if quick else round(share * EPISODES)}
    if share < 1:
        recipe = compose("demo", [f"data.path={data}", *fewer_steps(recipe, share)])
    what = f"simulating {training['train']} episodes"
    steps = recipe.trainer["max_steps"]
    closing = (
        Step(what, SIMULATING * share, lambda: _generate(recipe, data, training)),
        Step(f"training for {steps} steps", TRAINING * share, lambda: _fit(recipe, run)),
        Step("predicting the test episodes", CLOSING - 4, lambda: _evaluate(run)),
        Step("writing the report", 4, both),
    )
    progress.work(closing)
    print_summary(Summary.read(run))
    click.echo(f"report: {report}")


class Progress:
    """Works through steps, and says before each about how long all that are left will take.

    Attributes:
        spent: seconds that steps took so far.
        expected: seconds that these take on two idle cores with AVX-512.
    """

    def __init__(self, number: int) -> None:
        self.number, self.finished = number, 0
        self.spent = self.expected = 0.0

    @property
    def pace(self) -> float:
        """How many times as long as on two idle cores with AVX-512 it takes."""
        return self.spent / self.expected if self.expected else 1.0

    def work(self, steps: Sequence[Step], later: float = 0) -> None:
        """Do steps in order; others that follow later are expected to take so many seconds."""
        for number, step in enumerate(steps):
            seconds = self.pace * (later + sum(each.seconds for each in steps[number:]))
            self.finished += 1
            place = f"[{self.finished}/{self.number}]"
            minutes = max(1, round(seconds / 60))
            click.echo(f"{place} {step.what}; about {minutes} min left", err=True)
            started = time.monotonic()
            done = step.work()
            seconds = time.monotonic() - started
            click.echo(f"{place} {f'took {seconds:.0f} s' if done else 'already done'}", err=True)
            if done:
                self.spent += seconds
                self.expected += step.seconds


def share_of_time(folder: Path, progress: Progress) -> float:
    """The share of the episodes and steps that this machine has the time for."""
    kept = folder / SHARE
    if kept.exists():
        return float(json.loads(kept.read_text("utf-8"))["share"])
    if (folder / "run").exists():  # begun by a version that knew no shares
        return 1.0
    left = SECONDS - progress.spent - progress.pace * CLOSING
    affordable = left / (progress.pace * (SIMULATING + TRAINING))
    share = next((each for each in SHARES if each <= affordable), SHARES[-1])
    if share < 1:
        click.echo(
            f"this machine takes {progress.pace:.1f} times as long as two idle cores with AVX-512, "
            f"so the demo has {share:.0%} of its episodes and steps",
            err=True,
        )
    kept.write_text(json.dumps({"share": share}), "utf-8")
    return share


def fewer_steps(recipe: Recipe, share: float) -> list[str]:
    """Overrides for a share of the steps."""
    motion = recipe.objective.params["motion_steps"]
    return [
        f"objective.motion_steps={round(share * motion)}",
        f"trainer.max_steps={round(share * recipe.trainer['max_steps'])}",
    ]


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
