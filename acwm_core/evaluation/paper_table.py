"""A run's scores in the layout of the paper's main table, with the published ones below."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from acwm_core.evaluation.published import SPLITS
from acwm_core.evaluation.results import Summary


@dataclass(frozen=True)
class PaperColumn:
    """A metric as the paper prints it."""

    metric: str
    title: str
    scale: float
    decimals: int
    higher_is_better: bool


COLUMNS = (
    PaperColumn("mse", "MSE", 1000, 3, False),
    PaperColumn("m_mse", "M-MSE", 1000, 2, False),
    PaperColumn("ssim", "SSIM", 1, 3, True),
    PaperColumn("psnr", "PSNR", 1, 2, True),
)
"""MSE and M-MSE are in thousandths."""

DROP = "↓"
"""Marks what is worse out of distribution than in it."""


@dataclass(frozen=True)
class PaperLine:
    """One line: a name, and a text per split and column of `COLUMNS`; ``–`` where there is none."""

    name: str
    cells: Mapping[str, tuple[str, ...]]


def paper_lines(summary: Summary) -> list[PaperLine]:
    """The run's line and, if the paper has one of its environment, the published line."""
    ours = {
        split: {
            name: estimate.value
            for name, estimate in result.scores.rows["model"].items()
            if estimate.value is not None
        }
        for split, result in summary.splits.items()
    }
    lines = [PaperLine(summary.run, _cells(ours))]
    if summary.published:
        row = summary.published.row
        name = " ".join(["published:", row.row, row.column]).strip()
        lines.append(PaperLine(name, _cells(row.scores)))
    return lines


def about_published(summary: Summary) -> str:
    """What stands below the lines: where the published figures are from, and how far they compare.

    Empty without published figures.
    """
    if not summary.published:
        return ""
    row, same = summary.published.row, summary.published.same_parts
    setting = ", ".join(str(row.setting[part]) for part in ("model", "codec", "conditioner"))
    parts = [f"published: {row.citation}, {row.label} ({setting})"]
    if not same:
        parts.append("this run has other parts")
    if summary.protocol != "acwm-phys":
        parts.append("other clips than its windows: see --protocol acwm-phys")
    return "; ".join(parts) + (f". {row.note}" if row.note else "")


def _cells(scores: Mapping[str, Mapping[str, float]]) -> dict[str, tuple[str, ...]]:
    inside, outside = (scores.get(split, {}) for split in SPLITS)
    return {
        SPLITS[0]: tuple(_text(column, inside) for column in COLUMNS),
        SPLITS[1]: tuple(
            _text(column, outside) + (DROP if _worse(column, inside, outside) else "")
            for column in COLUMNS
        ),
    }


def _text(column: PaperColumn, scores: Mapping[str, float]) -> str:
    value = scores.get(column.metric)
    return "–" if value is None else f"{value * column.scale:.{column.decimals}f}"


def _worse(column: PaperColumn, inside: Mapping[str, float], outside: Mapping[str, float]) -> bool:
    near, far = inside.get(column.metric), outside.get(column.metric)
    if near is None or far is None:
        return False
    return far < near if column.higher_is_better else far > near
