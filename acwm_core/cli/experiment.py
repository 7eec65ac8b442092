"""`acwm experiment`: a table of runs, from simulation to report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import FOLDER
from acwm_core.data.atomic import writable
from acwm_core.errors import RecipeError

if TYPE_CHECKING:
    from acwm_core.experiment.plan import Plan
    from acwm_core.experiment.running import Outcome

HERE = (sys.executable, "-m", "acwm_core.cli.supervised")
"""How steps are run on this machine,"""

IN_JOBS = (sys.executable, "-m", "acwm_core.cli")
"""and in jobs of SLURM."""


@click.command()
@click.argument("file")
@click.argument("overrides", nargs=-1)
@click.option("--out", type=FOLDER, help="Folder of the experiment; experiments/FILE by default.")
@click.option("--seeds", help="Instead of those of FILE: 0,1,2.")
@click.option(
    "--runs", type=FOLDER, help="Folder of the runs; give experiments one to share what is equal."
)
@click.option("--plan", "only_plan", is_flag=True, help="Say what is done and what is left.")
@click.option(
    "--jobs", type=click.IntRange(1), default=1, show_default=True, help="Steps at once, here."
)
@click.option("--slurm", is_flag=True, help="Submit what is left as SLURM jobs instead.")
@click.option(
    "--sbatch",
    multiple=True,
    help="Options of sbatch: '--partition=gpu', or for one kind of step 'train=--time=24:00:00'.",
)
def experiment(
    file: str,
    overrides: tuple[str, ...],
    out: Path | None,
    seeds: str | None,
    runs: Path | None,
    only_plan: bool,
    jobs: int,
    slurm: bool,
    sbatch: tuple[str, ...],
) -> None:
    """Simulate, train, evaluate and report all runs of FILE.

    FILE is an experiment: a table whose cells are recipes, such as ablations/conditioning or its
    small twin ablations/conditioning_small. OVERRIDES change all its recipes, as in `acwm fit`.

    Stopped at any point, the same command goes on. A run that fails stops no other one; exit code 1
    tells of it in the end. --plan changes nothing and may be asked at any time.
    """
    from acwm_core.experiment.config import read_experiment
    from acwm_core.experiment.folder import ExperimentFolder
    from acwm_core.experiment.plan import make_plan

    if sbatch and not slurm:
        raise RecipeError("--sbatch is for --slurm")
    found = read_experiment(file, overrides, _seeds(seeds))
    folder = ExperimentFolder(out or Path("experiments", found.name))
    plan = make_plan(found, folder, runs)
    if only_plan:
        from acwm_core.experiment.overview import look

        for line in look(plan, jobs).text():
            click.echo(line)
        return
    for place in (folder.path, runs or folder.runs):
        writable(place, folder=True)
    if slurm:
        _submit(plan, sbatch)
    else:
        _run(plan, jobs)


def _run(plan: Plan, jobs: int) -> None:
    from acwm_core.experiment.running import run_experiment

    outcome = run_experiment(plan, HERE, jobs=jobs, say=_say)
    _tell(outcome)
    if plan.folder.report.exists():
        click.echo(f"report: {plan.folder.report}")
    if outcome.failures:
        sys.exit(1)


def _submit(plan: Plan, sbatch: tuple[str, ...]) -> None:
    from acwm_core.experiment.running import submit_experiment
    from acwm_core.experiment.slurm import parse_options

    jobs = submit_experiment(plan, IN_JOBS, parse_options(sbatch), say=_say)
    click.echo(f"{len(jobs)} jobs submitted; --plan says how far they are")


def _tell(outcome: Outcome) -> None:
    done = f", {outcome.done} of them before" if outcome.done else ""
    click.echo(f"{outcome.steps - len(outcome.failures)} of {outcome.steps} steps are done{done}")
    for step, reason in outcome.failures.items():
        log = outcome.ledger.log(step)
        click.echo(f"failed: {step}: {reason}" + (f" (see {log})" if log.exists() else ""))


def _say(line: str) -> None:
    click.echo(line, err=True)


def _seeds(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise RecipeError(f"--seeds {text}: give numbers such as 0,1,2") from None
