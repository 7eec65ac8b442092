"""`acwm evaluate`, `report`, `compare` and `leaderboard`, and `acwm data report`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import DATASET, FOLDER, OUT_FILE, OUT_FOLDER, RUN, Run
from acwm_core.errors import RecipeError
from acwm_core.files import writable
from acwm_report.terminal import print_severity, print_summary


class Evaluated(Run):
    """A run folder, or a folder with the scores of predictions that were handed in."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the folder."""
        from acwm_core.evaluation import results

        scored = (Path(value) / results.FOLDER / results.SUMMARY).is_file()
        return Path(value) if scored else super().convert(value, param, ctx)


EVALUATED = Evaluated("run folder", "recipe.yaml", "`acwm fit RECIPE`")


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
        compose(run / "recipe.yaml", overrides, sections=["evaluation"])

    if sweeps:
        from acwm_severity.sweep import sweep_severity

        for curve in sweep_severity(run, sweeps, data=data, overrides=overrides, **where):
            print_severity(curve)
        return

    from acwm_interventions.evaluate import evaluate_run

    print_summary(evaluate_run(run, data=data, overrides=overrides, **where))
    click.echo(f"next: acwm report {shlex.quote(str(where['out'] or run))}")


@click.command()
@click.argument("runs", type=FOLDER, nargs=-1, required=True, metavar="RUN...")
@click.option("--out", type=OUT_FILE, help="Output .html; report.html in the first RUN by default.")
@click.option(
    "--export", type=OUT_FOLDER, metavar="DIR", help="Also write tables and figures to this folder."
)
@click.option("--video-mb", default=16.0, help="Megabytes of video to embed.")
def report(runs: tuple[Path, ...], out: Path | None, export: Path | None, video_mb: float) -> None:
    """Write the report of evaluated runs.

    One self-contained HTML file with tables, curves and videos. Several runs are compared. An
    experiment's folder means its evaluated runs. --export writes the tables as CSV, Markdown
    and LaTeX, and the figures as PNG and PDF.
    """
    from acwm_experiment.table import Experiment, is_experiment
    from acwm_report.experiment import evaluated_runs

    found: list[Path] = []
    for run in runs:
        found += evaluated_runs(run) if is_experiment(run) else [EVALUATED.convert(run, None, None)]
    experiment = Experiment.read(runs[0]) if len(runs) == 1 and is_experiment(runs[0]) else None

    from acwm_report.page import export_report, write_report

    home = runs[0] if is_experiment(runs[0]) else found[0]
    page = write_report(
        found, out or home / "report.html", megabytes=video_mb, experiment=experiment
    )
    click.echo(page)
    click.echo(f"{page.stat().st_size / 1e6:.1f} MB", err=True)
    if export:
        click.echo(f"{len(export_report(found, export, experiment))} files in {export}")


@click.command()
@click.argument("runs", type=EVALUATED, nargs=-1, required=True, metavar="RUN RUN...")
@click.option("--metric", "metrics", multiple=True, help="Compare this metric; all by default.")
@click.option("--split", "splits", multiple=True, help="Compare on this split; all by default.")
@click.option("--out", type=OUT_FILE, help="Also write the result to this .json.")
@click.option(
    "--gate",
    is_flag=False,
    flag_value="",
    metavar="[METRIC,…]",
    help="End with exit code 1 if the second of two runs is significantly worse, in any metric or "
    "in these; give it last.",
)
def compare(
    runs: tuple[Path, ...],
    metrics: tuple[str, ...],
    splits: tuple[str, ...],
    out: Path | None,
    gate: str | None,
) -> int:
    """Test which runs differ significantly.

    Compares every pair of runs on common clips with a paired bootstrap over episodes. p-values are
    corrected for the number of comparisons (Holm).
    """
    from acwm_report.comparison import compare_runs, worsened
    from acwm_report.terminal import print_comparison

    gated = tuple(name.strip() for name in (gate or "").split(",") if name.strip())
    if gate is not None and (len(runs) != 2 or (gated and metrics)):
        raise RecipeError(
            "--gate compares two runs, and names its metrics itself: leave out --metric"
        )
    comparison = compare_runs(runs, metrics=gated or metrics, splits=splits)
    print_comparison(comparison)
    if out:
        comparison.write(out)
        click.echo(out)
    if gate is None:
        return 0
    worse = worsened(comparison)
    click.echo("\n".join(worse) or "gate: the second run is not significantly worse")
    return int(bool(worse))


@click.command()
@click.argument("folder", type=FOLDER, metavar="DIR")
@click.option("--out", type=OUT_FILE, help="Output .html; leaderboard.html in DIR by default.")
@click.option("--video-mb", default=16.0, help="Megabytes of video to embed.")
def leaderboard(folder: Path, out: Path | None, video_mb: float) -> None:
    """Collect the results of many runs in one page.

    Finds result files (summary.json) at any depth below DIR, and makes one table per environment,
    test data, protocol and capability, and a card of each entry. Names files that cannot be read.
    """
    from acwm_report.leaderboard import write_leaderboard

    page, found = write_leaderboard(folder, out, megabytes=video_mb)
    for name, why in found.broken.items():
        click.echo(f"left out {name}: {why}", err=True)
    click.echo(page)


@click.command()
@click.argument("path", type=DATASET)
@click.option("--out", type=OUT_FILE, help="Output .html; report.html in PATH by default.")
def data_report(path: Path, out: Path | None) -> None:
    """Write a page about the dataset PATH, and print what is wrong with it.

    One self-contained HTML file: sample videos, lengths, the range and histogram of each action,
    defective frames, test episodes that equal training episodes, and whether the video follows the
    actions, with what delay.
    """
    from acwm_formats.survey.survey import short_form, survey
    from acwm_report.data_page import write_data_report

    page = writable(out or path / "report.html", option="--out")
    found = survey(path)
    for line in short_form(found)[:-1]:
        click.echo(line)
    click.echo(write_data_report(found, page))
