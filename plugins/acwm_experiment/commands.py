"""`acwm experiment`: a table of runs, from simulation to report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import FOLDER, seed_numbers, split_options
from acwm_core.errors import RecipeError
from acwm_core.files import writable

if TYPE_CHECKING:
    from acwm_experiment.plan import ExperimentPlan

COMMAND = (sys.executable, "-P", "-m", "acwm_core.cli")
"""The command that runs a step; the words of the step are appended."""

_say = partial(click.echo, err=True)


@click.command()
@click.argument("file")
@click.argument("overrides", nargs=-1)
@click.option(
    "--grid",
    is_flag=True,
    help="FILE is a recipe, trained with every combination of values such as model.layers=2,3.",
)
@click.option("--out", type=FOLDER, help="Folder of the experiment; experiments/FILE by default.")
@click.option("--seeds", type=seed_numbers, help="Seeds instead of those of FILE: 0,1,2 or 0..49.")
@click.option(
    "--runs",
    type=FOLDER,
    help="Folder of the runs; experiments with the same folder share equal runs.",
)
@click.option("--plan", "only_plan", is_flag=True, help="List the steps and their state.")
@click.option("--jobs", type=click.IntRange(1), default=1, help="Parallel steps on this machine.")
@click.option(
    "--executor", help="Submit missing steps as jobs of a batch system, named as in `acwm list`."
)
def experiment(
    file: str,
    overrides: tuple[str, ...],
    grid: bool,
    out: Path | None,
    seeds: tuple[int, ...] | None,
    runs: Path | None,
    only_plan: bool,
    jobs: int,
    executor: str | None,
) -> None:
    """Simulate, train, evaluate, plan and report everything in FILE.

    FILE is an experiment: a table of recipes, such as ablations/conditioning or its small version
    ablations/conditioning_small. OVERRIDES change all recipes, as in `acwm fit`, or set
    options of --executor: executor.sbatch='--partition=gpu' for all jobs,
    executor.steps.train='--time=24:00:00' for one kind of step.

    A file may also list tasks to solve by planning, such as planning: all tasks, with the models
    that ship. If FILE trains nothing, OVERRIDES and --seeds are those of `acwm plan`.

    With --grid, FILE is a recipe: `acwm experiment push_cube_small --grid model.layers=2,3
    training.learning_rate=1e-3,4e-3` trains it four times and makes one table of the four.

    If it is interrupted, run the same command again to continue. A failed run does not stop the
    others; the exit code is then 1. --plan changes nothing and works at any time.
    """
    from acwm_core.recipe.trust import recipes_are_trusted
    from acwm_experiment.files import read_experiment
    from acwm_experiment.grid import read_grid
    from acwm_experiment.plan import make_plan
    from acwm_experiment.runner import overview, submit_experiment

    if grid:  # the recipe may come after the values, as if --grid took them
        words = sorted((file, *overrides), key=lambda word: "=" in word or word.startswith("+"))
        file, overrides = words[0], tuple(words[1:])
    overrides_of_recipes, options = split_options(overrides)
    if options and not executor:
        raise RecipeError(f"executor.{next(iter(options))} needs --executor")
    read = read_grid if grid else read_experiment
    content = read(file, overrides_of_recipes, seeds)
    folder = out or Path("experiments", content.experiment.name)
    plan = make_plan(content, folder, runs)
    if only_plan:
        for line in overview(plan):
            click.echo(line)
        return
    for place in (folder, runs or folder / "runs"):
        writable(place, folder=True)
    command = (*COMMAND, "--trust-recipe") if recipes_are_trusted() else COMMAND
    if executor:
        count = submit_experiment(plan, command, executor, options, say=_say)
        click.echo(f"{count} jobs submitted; --plan shows their progress")
    else:
        _run(plan, command, jobs)


def _run(plan: ExperimentPlan, command: Sequence[str], jobs: int) -> None:
    from acwm_experiment.runner import run_experiment

    steps, before, failures = run_experiment(plan, command, jobs=jobs, say=_say)
    done = f", {before} of them in earlier runs" if before else ""
    click.echo(f"{steps - len(failures)} of {steps} steps are done{done}")
    for step, reason in failures.items():
        log = plan.logs.log(step)
        click.echo(f"failed: {step}: {reason}" + (f" (see {log})" if log.exists() else ""))
    if plan.report.exists():
        click.echo(f"report: {plan.report}")
    if failures:
        click.get_current_context().exit(1)
