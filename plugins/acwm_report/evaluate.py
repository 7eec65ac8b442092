"""`acwm evaluate`: how good a trained model is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER, RUN
from acwm_core.plugins import catalog
from acwm_report.terminal import print_severity, print_summary


@click.command()
@click.argument("run", type=RUN)
@click.argument("overrides", nargs=-1)
@click.option("--data", type=DATASET, help="Dataset; by default the training dataset.")
@click.option(
    "--protocol",
    metavar="NAME",
    help="full (whole episodes) or one of `acwm list protocol`; the recipe's by default.",
)
@click.option(
    "--out",
    type=OUT_FOLDER,
    help="Folder to write to instead of RUN; reports accept it like a run.",
)
@click.option("--overwrite", is_flag=True, help="Replace a result with other settings.")
@click.option(
    "--sweep",
    "sweeps",
    multiple=True,
    metavar="factors.NAME=VALUES",
    help="Evaluate only the error against a factor: factors.friction=0.1..1.2, "
    "factors.cube_count=1..5 or factors.light=noon,evening. Simulates what it needs.",
)
def evaluate(
    run: Path,
    overrides: tuple[str, ...],
    data: Path | None,
    protocol: str | None,
    sweeps: tuple[str, ...],
    **where: Any,
) -> None:
    """Evaluate the model of RUN on test clips.

    Scores in and out of distribution, with reference rows such as the noise floor, and, if the
    recipe sets them, action responses and the predictability horizon. Writes RUN/evaluation:
    episodes.parquet, summary.json and videos. OVERRIDES change the settings: evaluation.steps=10
    evaluation.episodes=32.
    """
    from acwm_core.recipe import compose

    if protocol:
        overrides = (*overrides, f"evaluation.protocol={protocol}")
    if overrides:  # report misspelt ones before torch is imported
        compose(run / "recipe.yaml", overrides)

    if sweeps:
        from acwm_severity.sweep import sweep_severity

        for curve in sweep_severity(run, sweeps, data=data, overrides=overrides, **where):
            print_severity(curve)
        return

    from acwm_core.evaluation.evaluate import evaluate_run

    print_summary(evaluate_run(run, data=data, overrides=overrides, **where))
    if "report" in catalog().registry("command"):  # a plugin provides it
        click.echo(f"next: acwm report {where['out'] or run}")
