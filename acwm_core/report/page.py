"""`write_report`: one or more evaluated runs as a single HTML file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import read_results
from acwm_core.evaluation.results import FOLDER, VIDEOS, Summary, VideoRecord
from acwm_core.report.charts import RunCharts, horizon_comparison, training_comparison
from acwm_core.report.tables import (
    comparison_table,
    label_table,
    split_tables,
    steps_table,
    tiles,
)
from acwm_core.report.traces import action_traces
from acwm_core.report.wording import (
    Scale,
    label_title,
    metric_title,
    split_title,
    verdict,
    verdict_title,
)

REPORT = "report.html"


def write_report(runs: Sequence[str | Path], out: str | Path | None = None) -> Path:
    """Write a report of evaluated runs.

    The file embeds its videos, charts, style and script, and loads nothing: it can be mailed, put
    online, or opened offline.

    Args:
        runs: run folders; several are compared with one another.
        out: the ``.html`` to write; ``report.html`` in the first run's folder by default.

    Returns:
        The file.

    Raises:
        DataError: no run, or one that was not evaluated.
    """
    folders = [Path(run) for run in runs]
    if not folders:
        raise DataError("a report needs at least one run: name its folder")
    summaries = [Summary.read(folder) for folder in folders]
    pages = [
        _page_of(folder, summary, f"run{number}")
        for number, (folder, summary) in enumerate(zip(folders, summaries, strict=True), start=1)
    ]
    comparison = _comparison(folders, summaries) if len(pages) > 1 else None
    out = Path(out) if out else folders[0] / REPORT
    out.parent.mkdir(parents=True, exist_ok=True)
    html = _templates().get_template("report.html.j2").render(runs=pages, comparison=comparison)
    with written_whole(out) as partial:
        partial.write_text(html, encoding="utf-8")
    return out


def _templates() -> Environment:
    loader = PackageLoader("acwm_core.report", "templates")
    return Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _page_of(folder: Path, summary: Summary, key: str) -> dict[str, Any]:
    """What the template says of one run; `key` makes its ids unique."""
    charts = RunCharts(key, summary, read_results(folder), folder / "metrics.csv")
    return {
        "key": key,
        "name": summary.run,
        "folder": str(folder),
        "parts": summary.parts,
        "environment": summary.environment,
        "title": verdict_title(summary),
        "verdict": verdict(summary),
        "headline": metric_title(summary.headline),
        "tiles": [(split_title(split), tiles(summary, split)) for split in summary.splits],
        "videos": _videos(folder, summary),
        "tables": split_tables(summary),
        "labels": label_table(summary),
        "horizon": charts.horizon(),
        "pairs": charts.pairs(),
        "training": charts.training(),
        "steps": (charts.steps(), steps_table(summary)),
        "provenance": summary.provenance,
        "commands": commands(folder, summary),
    }


def commands(folder: Path, summary: Summary) -> list[str]:
    """What to type to make the dataset, the run and this report again."""
    data: dict[str, Any] = summary.provenance["dataset"]
    made = summary.provenance.get("imported") or f"acwm fit {folder}/recipe.yaml"
    return [
        data["command"],
        f"{made} --out {folder}-again",
        f"acwm evaluate {folder}-again",
        f"acwm report {folder}-again",
    ]


def _videos(folder: Path, summary: Summary) -> list[dict[str, Any]]:
    """Embedded videos, grouped by split."""
    groups: list[dict[str, Any]] = []
    for split in summary.splits:
        records = [record for record in summary.videos if record.split == split]
        # The median comes last, beside itself with other actions.
        records.sort(key=lambda record: (record.pick == "median", record.kind != "model"))
        if records:
            cards = [_video(folder, summary, record) for record in records]
            groups.append({"title": split_title(split), "cards": cards})
    return groups


def _video(folder: Path, summary: Summary, record: VideoRecord) -> dict[str, Any]:
    file = folder / FOLDER / VIDEOS / record.file
    try:
        data = base64.b64encode(file.read_bytes()).decode()
    except FileNotFoundError:
        raise DataError(
            f"the video {file} is missing: run `acwm evaluate {folder}` again"
        ) from None
    value, unit = record.values[summary.headline], summary.metrics[summary.headline].unit
    scale = Scale.of([value], unit)
    number = f"{scale.number(value)} {scale.unit}".strip()
    return {
        "data": Markup(data),
        "pick": record.pick,
        "kind": record.kind,
        "episode": record.episode,
        "label": label_title(record.ood_label),
        "score": f"{metric_title(summary.headline)} {number}",
        "traces": action_traces(record.actions, summary.environment["action"]),
    }


def _comparison(folders: Sequence[Path], summaries: Sequence[Summary]) -> dict[str, Any]:
    names = [summary.run for summary in summaries]
    files = [folder / "metrics.csv" for folder in folders]
    return {
        "table": comparison_table(summaries),
        "horizon": horizon_comparison(summaries),
        "training": training_comparison(list(zip(names, files, strict=True))),
    }
