"""Tables as data: numbers as they are written, columns, rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

from acwm_core.evaluation.results import Estimate, MetricInfo

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


PLAIN = Scale(1.0, 2, "")
"""The scale of numbers without a unit."""

PERCENT = Scale(100.0, 0, "%")


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
    better: str = ""  # what is better: ``"↑"``, ``"↓"``, ``"→ 1"`` for one right value, or empty
    group: str = ""  # common heading of a group of columns
    # the column's name in CSV, where numbers have the metric's own unit; the title by default
    key: str = ""

    @classmethod
    def of(cls, info: MetricInfo, scale: Scale, key: str, group: str = "") -> Column:
        """The head of a column of scores."""
        better = "↑" if info.higher_is_better else "↓"
        better = better if info.right is None else f"→ {info.right:g}"
        return cls(info.title, scale.unit, better, group, key)


@dataclass(frozen=True)
class Row:
    """A line of a table."""

    title: str  # in the first column
    cells: list[Cell]  # one per column
    note: str = ""  # small text below the title
    colour: str = ""  # CSS variable of its swatch, or ``""``
    strong: bool = False  # whether it is emphasised
    group: str = ""  # heading that it shares with neighbouring rows
    muted: bool = False  # whether it is grey, like a published figure
    link: str = ""  # an id on the page that the title links to, or empty


@dataclass(frozen=True)
class Table:
    """A table with its heading."""

    title: str  # above the table
    columns: list[Column]  # all but the first
    rows: list[Row]  # in order
    corner: str = ""  # heading of the first column
    caption: str = ""  # explanation below the table
    name: str = ""  # name of the files that it is exported to

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns and the number of columns each spans; empty without groups."""
        spans = [(g, len(list(c))) for g, c in itertools.groupby(self.columns, lambda c: c.group)]
        return spans if any(group for group, _ in spans) else []

    @property
    def row_groups(self) -> list[tuple[str, list[Row]]]:
        """Each heading with the rows below it."""
        return [(g, list(rows)) for g, rows in itertools.groupby(self.rows, lambda row: row.group)]
