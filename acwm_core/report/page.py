"""`write_report`, `export_report`: evaluated runs as one HTML file, and as tables and figures."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from acwm_core.data.atomic import writable, written_whole
from acwm_core.experiment.folder import Experiment
from acwm_core.report import charts, tables
from acwm_core.report.comparison import environment, run_labels
from acwm_core.report.figures import Chart
from acwm_core.report.reproduce import commands, evaluate_command, protocol_text
from acwm_core.report.run import (
    OVER,
    EvaluatedRun,
    branch_title,
    label_title,
    read_runs,
    split_title,
    verdict_title,
)
from acwm_core.report.score_tables import experiment_tables, main_table
from acwm_core.report.table import Table, to_csv, to_latex, to_markdown
from acwm_core.report.videos import MEGABYTES, action_traces, embed_videos

REPORT = "report.html"

MAX_OPEN_RUNS = 3
"""With more runs than these, the section of each is folded up."""

FORMATS = {".csv": to_csv, ".md": to_markdown, ".tex": to_latex}


CHARTS: Mapping[str, Callable[[EvaluatedRun], list[Chart]]] = {
    "horizon": lambda run: charts.horizon_charts(run, run.summary.headline),
    "states": charts.state_horizon_charts,
    "pairs": charts.pair_charts,
    "responses": charts.response_charts,
    "predictability": charts.predictability_charts,
    "severity": lambda run: charts.severity_charts(run)[0],
    "steps": charts.steps_charts,
    "training": charts.training_charts,
}
"""The charts of a run by the section of the page that they stand in."""

TABLES: Mapping[str, Callable[[EvaluatedRun], list[Table]]] = {
    "scores": tables.score_tables,
    "states": tables.state_tables,
    "responses": tables.response_tables,
    "labels": tables.label_tables,
    "steps": tables.steps_tables,
}
"""Its tables, likewise; but for that of all clips."""


def write_report(
    runs: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    megabytes: float = MEGABYTES,
    experiment: Experiment | None = None,
) -> Path:
    """Write a report of evaluated runs.

    The file embeds its videos, charts, style and script, and loads nothing: it can be mailed, put
    online, or opened offline.

    Args:
        runs: run folders; several are compared with one another.
        out: the ``.html`` to write; ``report.html`` in the first run's folder by default.
        megabytes: of videos to embed at most; the rest stay in the runs' folders.
        experiment: what the runs belong to; its tables head the page.

    Returns:
        The file.

    Raises:
        DataError: no run, one that was not evaluated, or `out` cannot be written.
    """
    found = read_runs(runs)
    out = writable(Path(out) if out else found[0].folder / REPORT)
    title = " · ".join(run.summary.run for run in found)
    if len(found) > MAX_OPEN_RUNS:
        title = f"{len(found)} runs compared"
    return write_page(
        out,
        "report.html.j2",
        runs=found,
        all_videos=embed_videos(found, megabytes),
        names=run_labels([run.folder for run in found]),
        main=_main_table(found, experiment),
        comparison=_comparison(found),
        title=experiment.title if experiment else title,  # its caption stands below its table
        experiment=experiment_tables(experiment, {run.folder: run.key for run in found}),
        folded=len(found) > MAX_OPEN_RUNS or experiment is not None,
        tables=TABLES,
        charts=CHARTS,
        episode_table=tables.episode_table,
        severity_of=charts.severity_charts,
        commands_of=commands,
        evaluate_command=evaluate_command,
        protocol_text=protocol_text,
        verdict_title=verdict_title,
    )


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
    for part in ("tables", "figures"):
        writable(folder / part, folder=True)
    names = run_labels([run.folder for run in found]) if len(found) > 1 else [""]
    comparison = _comparison(found)
    shown = [_main_table(found, experiment), *experiment_tables(experiment)]
    if isinstance(comparison["differences"], Table):
        shown.append(comparison["differences"])
    written = _write(folder, list(filter(None, shown)), comparison["horizon"], "")
    for name, run in zip(names, found, strict=True):
        its_tables = [
            *(t for make in TABLES.values() for t in make(run)),
            tables.episode_table(run),
        ]
        figures = [chart for make in CHARTS.values() for chart in make(run)]
        written += _write(folder / name.replace("/", "-"), its_tables, figures, f"{run.key}-")
    return written


def _main_table(runs: Sequence[EvaluatedRun], experiment: Experiment | None) -> Table | None:
    """None where the experiment's own table is the same."""
    return None if experiment and experiment.table == "main" else main_table(runs)


def _comparison(runs: Sequence[EvaluatedRun]) -> dict[str, Any]:
    """Differences between several runs, where they are of one environment."""
    if len(runs) == 1 or len({environment(run.summary) for run in runs}) > 1:
        return {"differences": None, "horizon": []}
    names = run_labels([run.folder for run in runs])
    return {
        "differences": tables.significance_table(runs),
        "horizon": charts.horizon_comparison(runs, names),
    }


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Write a page whole or not at all, everything that it shows escaped.

    Raises:
        DataError: it cannot be written there.
    """
    templates: Any = Environment(
        loader=PackageLoader("acwm_core.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals.update(
        action_traces=action_traces,
        baselines=OVER,
        branch_title=branch_title,
        label_title=label_title,
        split_title=split_title,
    )
    html = templates.get_template(template).render(**content)
    return _write_text(writable(path), html)


def _write(
    folder: Path, made: Sequence[Table], figures: Sequence[Chart], prefix: str
) -> list[Path]:
    """Tables and figures in all formats, the latter without the prefix of their names."""
    written: list[Path] = []
    for table, (ending, text) in itertools.product(made, FORMATS.items()):
        written.append(_write_text(folder / "tables" / f"{table.name}{ending}", text(table)))
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    for chart, ending in itertools.product(figures, (".png", ".pdf")):
        path = folder / "figures" / f"{chart.name.removeprefix(prefix)}{ending}"
        chart.save(path)
        written.append(path)
    return written


def _write_text(path: Path, text: str) -> Path:
    """Write a file whole or not at all, into a folder that need not exist yet."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path
