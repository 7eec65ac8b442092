"""`write_report`: one or more evaluated runs as a single HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from acwm_core.data.atomic import writable, written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import ClipResult, read_results
from acwm_core.evaluation.results import Summary
from acwm_core.experiment.folder import Experiment
from acwm_core.report.again import commands
from acwm_core.report.answers import predictability_chart, response_charts, response_tables
from acwm_core.report.charts import RunCharts, horizon_comparison, training_comparison
from acwm_core.report.comparison import run_labels
from acwm_core.report.episodes import episode_table
from acwm_core.report.films import MEGABYTES, choose_films, reel
from acwm_core.report.main_table import main_table
from acwm_core.report.severity_charts import severity_charts
from acwm_core.report.significance import significance_table
from acwm_core.report.table import Table
from acwm_core.report.tables import (
    comparison_table,
    label_table,
    measure_tables,
    split_tables,
    steps_table,
    tiles,
)
from acwm_core.report.wording import (
    floor_text,
    metric_title,
    protocol_text,
    split_title,
    verdict,
    verdict_title,
)

REPORT = "report.html"

OPEN_RUNS = 3
"""With more runs than these, the section of each is folded up."""


@dataclass(frozen=True)
class Run:
    """An evaluated run, read from its folder.

    Attributes:
        folder: its folder.
        summary: its scores.
        results: rows of all its clips.
        key: makes its ids unique on a page.
    """

    folder: Path
    summary: Summary
    results: list[ClipResult]
    key: str

    @property
    def charts(self) -> RunCharts:
        """Its charts."""
        return RunCharts(self.key, self.summary, self.results, self.folder / "metrics.csv")


def read_runs(runs: Sequence[str | Path]) -> list[Run]:
    """Read evaluated runs.

    Raises:
        DataError: no run, or one that was not evaluated.
    """
    folders = [Path(run) for run in runs]
    if not folders:
        raise DataError("a report needs at least one run: name its folder")
    summaries = [Summary.read(folder) for folder in folders]
    return [
        Run(folder, summary, read_results(folder), f"run{number}")
        for number, (folder, summary) in enumerate(zip(folders, summaries, strict=True), start=1)
    ]


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
    chosen = choose_films([r.folder for r in found], [r.summary for r in found], megabytes)
    pages = [_page_of(run, files) for run, files in zip(found, chosen, strict=True)]
    html = (
        templates()
        .get_template("report.html.j2")
        .render(
            runs=pages,
            main=None if is_main(experiment) else main_table([run.summary for run in found]),
            comparison=_comparison(found) if len(found) > 1 else None,
            heading=_heading(found, experiment),
            ablations=experiment_tables(experiment, {run.folder: run.key for run in found}),
            folded=len(found) > OPEN_RUNS or experiment is not None,
        )
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(out) as partial:
        partial.write_text(html, encoding="utf-8")
    return out


def is_main(experiment: Experiment | None) -> bool:
    """Whether an experiment's own table is the main one, which then need not be shown twice."""
    return experiment is not None and experiment.table == "main"


def experiment_tables(
    experiment: Experiment | None, links: Mapping[Path, str] | None = None
) -> list[Table]:
    """The tables of an experiment, whose titles lead to its runs; none without one."""
    if experiment is None:
        return []
    from acwm_core.report.experiment_table import ExperimentTables  # its statistics need torch

    return ExperimentTables(experiment, links).tables()


def _heading(runs: Sequence[Run], experiment: Experiment | None) -> dict[str, str]:
    if experiment:
        return {"title": experiment.title, "text": ""}  # its caption stands below its table
    if len(runs) > OPEN_RUNS:
        return {"title": f"{len(runs)} runs compared", "text": ""}
    return {"title": " · ".join(run.summary.run for run in runs), "text": ""}


def templates() -> Environment:
    """The pages' templates."""
    return Environment(
        loader=PackageLoader("acwm_core.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _page_of(run: Run, chosen: set[str]) -> dict[str, Any]:
    """What the template says of one run."""
    summary, charts = run.summary, run.charts
    return {
        "key": run.key,
        "name": summary.run,
        "folder": str(run.folder),
        "parts": summary.parts,
        "environment": summary.environment,
        "title": verdict_title(summary),
        "verdict": verdict(summary),
        "headline": metric_title(summary.headline),
        "tiles": [(split_title(split), tiles(summary, split)) for split in summary.splits],
        "reel": reel(run.folder, summary, run.key, chosen),
        "tables": split_tables(summary),
        "measures": (measure_tables(summary), charts.state_horizon()),
        "floor": floor_text(summary),
        "left_out": summary.left_out,
        "labels": label_table(summary),
        "severity": severity_charts(run.folder, run.key),
        "horizon": charts.horizon(),
        "predictability": predictability_chart(summary, run.key),
        "answers": (response_tables(summary), response_charts(summary, run.key)),
        "pairs": charts.pairs(),
        "training": charts.training(),
        "steps": (charts.steps(), steps_table(summary)),
        "episodes": episode_table(summary, run.results, run.key, chosen),
        "protocol": (summary.protocol, protocol_text(summary)),
        "provenance": summary.provenance,
        "commands": commands(run.folder, summary),
    }


def _comparison(runs: Sequence[Run]) -> dict[str, Any]:
    """Runs side by side; their differences too, where they are of one environment."""
    summaries = [run.summary for run in runs]
    folders = [run.folder for run in runs]
    names = run_labels(folders)
    alike = len({each.parts["env"] for each in summaries}) == 1
    logs = [(name, run.folder / "metrics.csv") for name, run in zip(names, runs, strict=True)]
    return {
        "names": names,
        "table": comparison_table(summaries, names) if alike else None,
        "significance": significance_table(folders) if alike else None,
        "horizon": horizon_comparison(summaries, names) if alike else [],
        "training": training_comparison(logs),
    }
