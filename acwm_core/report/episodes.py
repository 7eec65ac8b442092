"""Every clip of a run as a line of a table that can be sorted."""

from __future__ import annotations

from collections.abc import Sequence, Set

from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.results import Estimate, Summary, finite
from acwm_core.report.films import BRANCH, film_key
from acwm_core.report.table import Cell, Column, Row, Table
from acwm_core.report.wording import MISSING, label_title, metric_scale, metric_title, split_title


def episode_table(
    summary: Summary, results: Sequence[ClipResult], key: str, chosen: Set[str]
) -> Table:
    """The model's scores of every clip, the worst first, with links to the embedded videos.

    Args:
        summary: of the run.
        results: all rows of all clips.
        key: of the run on the page.
        chosen: files of the videos that the page embeds.
    """
    headline, better = summary.headline, summary.metrics[summary.headline].higher_is_better
    others = {_clip(r): r for r in results if r.kind == "shuffled"}
    films = {
        (v.split, v.episode, v.start): film_key(key, v)
        for v in summary.videos
        if v.file in chosen and v.kind == "model" and not v.kind.startswith(BRANCH)
    }
    models = [r for r in results if r.kind == "model"]
    sign = 1 if better else -1
    models.sort(key=lambda r: (list(summary.splits).index(r.split), sign * _sortable(r, headline)))
    windows = any(r.start for r in models)
    rows = [
        _row(r, summary, others.get(_clip(r)), films.get(_clip(r), ""), windows) for r in models
    ]
    return Table("", _columns(summary, windows), rows, "Episode", name="episodes")


def _columns(summary: Summary, windows: bool) -> list[Column]:
    columns = [Column("Split", key="split"), Column("Shifted", key="shifted")]
    if windows:
        columns.append(Column("From frame", key="start"))
    columns.append(Column("Video", key="video"))
    for name, info in summary.metrics.items():
        unit = metric_scale(summary, name).unit
        way = "↑" if info.higher_is_better else "↓"
        columns.append(Column(metric_title(name), unit, way, key=name))
        if name == summary.headline:
            columns.append(Column("over other actions", unit, key=f"{name}_over_other_actions"))
    return columns


def _row(
    result: ClipResult, summary: Summary, other: ClipResult | None, film: str, windows: bool
) -> Row:
    label = label_title(result.ood_label)
    cells = [Cell(split_title(result.split)), Cell(label or MISSING)]
    if windows:
        cells.append(Cell(str(result.start), value=result.start))
    cells.append(Cell("▶ play" if film else "", link=film))
    for name, info in summary.metrics.items():
        scale = metric_scale(summary, name)
        value = result.values[name]
        cells.append(Cell.of(Estimate(finite(value)), scale))
        if name == summary.headline:
            gain = value - other.values[name] if other else float("nan")
            gain = gain if info.higher_is_better else -gain
            cells.append(Cell.of(Estimate(finite(gain)), scale, signed=True))
    return Row(str(result.episode), "", "", cells)


def _clip(result: ClipResult) -> tuple[str, int, int]:
    return result.split, result.episode, result.start


def _sortable(result: ClipResult, name: str) -> float:
    value = finite(result.values[name])
    return float("inf") if value is None else value
