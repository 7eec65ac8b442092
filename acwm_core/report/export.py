"""`export_report`: the tables and figures of a report as files for papers and slides."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from acwm_core.data.atomic import writable, written_whole
from acwm_core.experiment.folder import Experiment
from acwm_core.report.answers import predictability_chart, response_charts, response_tables
from acwm_core.report.charts import Chart, horizon_comparison
from acwm_core.report.comparison import run_labels
from acwm_core.report.episodes import episode_table
from acwm_core.report.figures import write_figure
from acwm_core.report.main_table import main_table
from acwm_core.report.page import Run, experiment_tables, is_main, read_runs
from acwm_core.report.severity_charts import severity_charts
from acwm_core.report.significance import significance_table
from acwm_core.report.table import Table, to_csv, to_latex, to_markdown
from acwm_core.report.tables import (
    comparison_table,
    label_table,
    measure_tables,
    split_tables,
    steps_table,
)

TABLES, FIGURES = "tables", "figures"
"""Folders of an export."""

FORMATS = {".csv": to_csv, ".md": to_markdown, ".tex": to_latex}


def export_report(
    runs: Sequence[str | Path], folder: str | Path, experiment: Experiment | None = None
) -> list[Path]:
    """Write the tables of a report as CSV, Markdown and LaTeX, and its figures as PNG and PDF.

    With several runs, what belongs to one of them lies in a folder of its own.

    Args:
        runs: run folders.
        folder: gets ``tables`` and ``figures``; files of the same name are replaced.
        experiment: what the runs belong to, for its own tables.

    Returns:
        The files.

    Raises:
        DataError: no run, one that was not evaluated, or `folder` cannot be written.
    """
    found, folder = read_runs(runs), Path(folder)
    for part in (TABLES, FIGURES):
        writable(folder / part, folder=True)
    summaries = [run.summary for run in found]
    main = None if is_main(experiment) else main_table(summaries)
    written = _write_tables([main, *experiment_tables(experiment)], folder)
    if len(found) == 1:
        return written + _export_run(found[0], folder)
    names = run_labels([run.folder for run in found])
    for name, run in zip(names, found, strict=True):
        written += _export_run(run, folder / name.replace("/", "-"))
    alike = len({summary.parts["env"] for summary in summaries}) == 1
    differences = significance_table([run.folder for run in found])
    tables = [comparison_table(summaries, names) if alike else None]
    tables += [differences] if isinstance(differences, Table) else []
    charts = horizon_comparison(summaries, names) if alike else []
    return written + _write_tables(tables, folder) + _write_figures(charts, folder)


def _export_run(run: Run, folder: Path) -> list[Path]:
    summary, charts = run.summary, run.charts
    tables = [
        *split_tables(summary),
        *measure_tables(summary),
        *response_tables(summary),
        label_table(summary),
        steps_table(summary),
        episode_table(summary, run.results, run.key, set()),
    ]
    figures = [
        *charts.horizon(),
        *charts.state_horizon(),
        *charts.pairs(),
        *response_charts(summary, run.key),
        predictability_chart(summary, run.key),
        *severity_charts(run.folder, run.key).charts,
        charts.steps(),
        charts.training(),
    ]
    return _write_tables(tables, folder) + _write_figures(figures, folder, f"{run.key}-")


def _write_tables(tables: Iterable[Table | None], folder: Path) -> list[Path]:
    written: list[Path] = []
    for table in filter(None, tables):
        for ending, text in FORMATS.items():
            path = folder / TABLES / f"{table.name}{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as partial:
                partial.write_text(text(table), encoding="utf-8")
            written.append(path)
    return written


def _write_figures(charts: Iterable[Chart | None], folder: Path, prefix: str = "") -> list[Path]:
    written: list[Path] = []
    for chart in filter(None, charts):
        for ending in (".png", ".pdf"):
            path = folder / FIGURES / f"{chart.name.removeprefix(prefix)}{ending}"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_figure(chart.drawing, path, chart.title, chart.legend)
            written.append(path)
    return written
