"""Scores formatted for tables: digits, units, and one row per model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from acwm_core.errors import AcwmError
from acwm_core.evaluation.benchmark import PublishedRow
from acwm_core.evaluation.results import Estimate, MetricInfo, Summary
from acwm_core.plugins import catalog

SPLITS = {
    "train": "Training episodes",
    "ind_test": "In distribution",
    "ood_test": "Out of distribution",
}
"""Titles of the splits."""

ModelScores = Mapping[tuple[str, str], Estimate]
"""A model's scores by split and metric."""

CAPTION = "▼: worse out of distribution than in distribution."

MINUS, MISSING, INFINITE = "−", "–", "∞"


@dataclass(frozen=True)
class Scale:
    """How the numbers of one metric are written."""

    factor: float  # numbers are multiplied by it
    decimals: int  # digits after the decimal point
    unit: str  # ``"dB"``, ``"mm"`` (for metres), ``"×10⁻³"`` or ``""``

    @classmethod
    def of(cls, values: Iterable[float | None], info: MetricInfo) -> Scale:
        """One scale for numbers shown together: three or four significant digits of the largest.

        Metres become millimetres. Numbers without unit or factor become thousandths if all are
        small.
        """
        finite = (abs(v) for v in values if v is not None and math.isfinite(v))
        largest = max(finite, default=1.0)
        factor, unit = info.factor, info.unit
        if unit == "m":
            factor, unit = 1000.0, "mm"
        elif factor is None:
            factor = 1000.0 if not unit and 0 < largest < 0.1 else 1.0
        magnitude = math.floor(math.log10(largest * factor)) if largest else 0
        unit = unit or ("×10⁻³" if factor == 1000.0 else "")
        return cls(factor, min(3, max(0, 3 - magnitude)), unit)

    def number(self, value: float | None, *, signed: bool = False) -> str:
        """``24.31``, or ``+3.10`` and ``−0.42`` if signed."""
        if value is None:
            return MISSING
        text = f"{abs(value) * self.factor:.{self.decimals}f}"
        is_negative = value < 0 and float(text)
        text = text.replace("inf", INFINITE)
        return MINUS + text if is_negative else f"+{text}" if signed else text

    def interval(self, estimate: Estimate, *, signed: bool = False) -> str:
        """``24.0 to 24.6``; empty without an interval."""
        if estimate.low is None or estimate.high is None:
            return ""
        low, high = (self.number(v, signed=signed) for v in (estimate.low, estimate.high))
        return f"{low} to {high}"


@dataclass(frozen=True)
class Cell:
    """A number with its interval in small print below it."""

    text: str  # the number as displayed
    interval: str = ""  # its 95 % confidence interval as displayed
    # the number itself, neither scaled nor rounded; None for text and gaps
    value: float | None = None
    low: float | None = None  # lower end of the interval
    high: float | None = None  # upper end
    worse: bool = False  # whether the score is worse out of distribution than in distribution
    link: str = ""  # id on the page to which the cell links, or empty

    @classmethod
    def of(
        cls, number: Estimate | None, scale: Scale, *, signed: bool = False, worse: bool = False
    ) -> Cell:
        """A cell for an estimate in this scale; a gap if there is none."""
        estimate = number or Estimate(None)
        text = scale.number(estimate.value, signed=signed)
        interval = scale.interval(estimate, signed=signed)
        return cls(text, interval, estimate.value, estimate.low, estimate.high, worse)


@dataclass(frozen=True)
class Column:
    """The head of a column."""

    title: str  # as displayed
    unit: str = ""  # unit of the displayed numbers, or empty
    better: str = ""  # direction that is better: ``"↑"``, ``"↓"`` or empty
    group: str = ""  # common heading of a group of columns
    # the column's name in CSV, where numbers have the metric's own unit; the title by default
    key: str = ""

    @classmethod
    def of(cls, info: MetricInfo, scale: Scale, key: str, group: str = "") -> Column:
        """The head of a column of scores."""
        return cls(info.title, scale.unit, "↑" if info.higher_is_better else "↓", group, key)


@dataclass(frozen=True)
class ScoreGrid:
    """Columns of scores, and the cells of each model in them."""

    places: Sequence[tuple[str, str]]  # split and metric of each column
    metrics: Mapping[str, MetricInfo]  # all of them
    scales: Mapping[str, Scale]  # by metric

    @classmethod
    def of(cls, models: Sequence[ModelScores], metrics: Mapping[str, MetricInfo]) -> ScoreGrid:
        """A grid for models, with as many digits as the smallest score of each metric needs."""
        scales: dict[str, Scale] = {}
        for name, info in metrics.items():
            scores = [score for model in models for (_, of), score in model.items() if of == name]
            values = (abs(each.value) for each in scores if each.value)
            smallest = min(filter(math.isfinite, values), default=None)
            scales[name] = Scale.of([smallest], info)
        splits = dict.fromkeys(split for model in models for split, _ in model)
        return cls([(split, name) for split in splits for name in metrics], metrics, scales)

    def columns(self, heading: str | None = None) -> list[Column]:
        """The columns; with several grids, `heading` distinguishes the columns of this one."""
        columns: list[Column] = []
        for split, name in self.places:
            group = " · ".join(filter(None, (heading, split_title(split))))
            key = ("_" if heading is None else " ").join(filter(None, (heading, split, name)))
            columns.append(Column.of(self.metrics[name], self.scales[name], key, group))
        return columns

    def cells(self, scores: ModelScores) -> list[Cell]:
        """A model's scores, marked where they are worse out of distribution than in it."""
        cells: list[Cell] = []
        for split, name in self.places:
            score, near = scores.get((split, name)), scores.get(("ind_test", name))
            worse = False
            if split == "ood_test" and score and near and None not in (score.value, near.value):
                change = (score.value or 0) - (near.value or 0)
                worse = change < 0 if self.metrics[name].higher_is_better else change > 0
            cells.append(Cell.of(score, self.scales[name], worse=worse))
        return cells


def model_scores(summary: Summary) -> ModelScores:
    """The scores of the row ``model``, by split and metric."""
    splits = summary.splits.items()
    return {(s, name): score for s, x in splits for name, score in x.scores.rows["model"].items()}


def published_scores(row: PublishedRow | None) -> ModelScores:
    """The scores of a published row, without intervals; empty if there is no row."""
    splits = row.scores.items() if row else ()
    return {(s, name): Estimate(value) for s, scores in splits for name, value in scores.items()}


def compared_metrics(summaries: Sequence[Summary]) -> dict[str, MetricInfo]:
    """The pixel metrics that were measured; only the published ones, if there are any."""
    metrics = {name: info for each in summaries for name, info in described(each.metrics).items()}
    pixels = {name: info for name, info in metrics.items() if info.reads == "pixels"}
    quoted = [published_scores(each.published.row) for each in summaries if each.published]
    published = {name for scores in quoted for _, name in scores}
    return {n: info for n, info in pixels.items() if n in published} or pixels


def described(metrics: Mapping[str, MetricInfo]) -> dict[str, MetricInfo]:
    """Metrics with all the facts that tables need.

    Old results hold only the unit; the rest is taken from the metric registered under the name, if
    there is one.
    """
    return {name: info if info.title else _looked_up(name, info) for name, info in metrics.items()}


def _looked_up(name: str, info: MetricInfo) -> MetricInfo:
    try:
        asked = catalog().component("metric", name).load()
    except (AcwmError, ImportError):
        asked = info
    known = {
        each: getattr(asked, each, getattr(info, each))
        for each in ("title", "group", "reads", "factor", "rank")
    }
    words = name.upper().replace("_", "-") if len(name) <= 5 else name.replace("_", " ")
    return replace(info, **{**known, "title": known["title"] or words[0].upper() + words[1:]})


def split_title(split: str) -> str:
    """The title of a split."""
    return SPLITS.get(split, split)
