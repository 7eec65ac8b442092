"""Tables as data, with numbers on their scales, and as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from acwm_core.evaluation.results import Estimate, MetricInfo

MINUS, MISSING, INFINITE = "−", "–", "∞"


@dataclass(frozen=True)
class Scale:
    """How the numbers of one metric are written."""

    factor: float  # they are multiplied by it
    decimals: int  # digits after the point
    unit: str  # ``"dB"``, ``"mm"`` (of metres), ``"×10⁻³"`` or ``""``

    @classmethod
    def of(cls, values: Iterable[float | None], info: MetricInfo) -> Scale:
        """One scale for numbers that stand together: about three significant digits of the largest.

        Metres become millimetres; numbers without unit or factor, thousandths if all are small.
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
    """A number and, small below it, its interval."""

    text: str  # the number as it is read
    interval: str = ""  # its 95 % confidence interval, as it is read
    # the number itself, neither scaled nor rounded; None for words and gaps
    value: float | None = None
    low: float | None = None  # lower end of the interval
    high: float | None = None  # upper end
    worse: bool = False  # it is a score that is worse out of distribution than in distribution
    link: str = ""  # an id on the page that the cell leads to, or empty

    @classmethod
    def of(
        cls, number: Estimate | None, scale: Scale, *, signed: bool = False, worse: bool = False
    ) -> Cell:
        """An estimate, written with its scale; a gap if there is none."""
        estimate = number or Estimate(None)
        text = scale.number(estimate.value, signed=signed)
        interval = scale.interval(estimate, signed=signed)
        return cls(text, interval, estimate.value, estimate.low, estimate.high, worse)


@dataclass(frozen=True)
class Column:
    """The head of a column."""

    title: str  # as it is read
    unit: str = ""  # of the numbers as they are written, or empty
    better: str = ""  # which way is: ``"↑"``, ``"↓"`` or empty
    group: str = ""  # columns of one group stand under a common heading
    # the column's name in CSV, where numbers have the metric's own unit; the title by default
    key: str = ""

    @classmethod
    def of(cls, info: MetricInfo, scale: Scale, key: str, group: str = "") -> Column:
        """The head of a column of scores."""
        return cls(info.title, scale.unit, "↑" if info.higher_is_better else "↓", group, key)


@dataclass(frozen=True)
class Row:
    """A line of a table."""

    title: str  # in the first column
    cells: list[Cell]  # one per column
    note: str = ""  # small below the title
    colour: str = ""  # CSS variable of its swatch, or ``""``
    strong: bool = False  # set off from the others
    group: str = ""  # rows of one group stand together under its name
    muted: bool = False  # set back, as a figure that is quoted beside the others
    link: str = ""  # an id on the page that the title leads to, or empty


@dataclass(frozen=True)
class Table:
    """A table with its heading."""

    title: str  # above it
    columns: list[Column]  # all but the first
    rows: list[Row]  # in order
    corner: str = ""  # head of the first column
    caption: str = ""  # what a reader must know, below it
    name: str = ""  # of the files that it is exported to

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings over the columns, and how many columns each spans; empty without groups."""
        spans = [(g, len(list(c))) for g, c in itertools.groupby(self.columns, lambda c: c.group)]
        return spans if any(group for group, _ in spans) else []

    @property
    def row_groups(self) -> list[tuple[str, list[Row]]]:
        """Rows under the heading that they share."""
        return [(g, list(rows)) for g, rows in itertools.groupby(self.rows, lambda row: row.group)]


def to_csv(table: Table) -> str:
    """Comma-separated values at full precision, with the ends of intervals in their own columns.

    Numbers are in the metrics' own units, not in thousandths; gaps are empty.
    """
    grouped = any(row.group for row in table.rows)
    head = ["group"] * grouped + [table.corner or "row", "note"]
    lines = [[row.group] * grouped + [row.title, row.note] for row in table.rows]
    for index, column in enumerate(table.columns):
        cells = [row.cells[index] for row in table.rows]
        key = column.key or " ".join(filter(None, (column.group, column.title)))
        bounded = any(cell.low is not None for cell in cells)
        head += [key, f"{key}_low", f"{key}_high"] if bounded else [key]
        for line, cell in zip(lines, cells, strict=True):
            words = "" if cell.text == MISSING else cell.text
            line.append(words if cell.value is None else repr(float(cell.value)))
            ends = (cell.low, cell.high) if bounded else ()
            line += ["" if end is None else repr(float(end)) for end in ends]
    file = io.StringIO()
    inert = ([_no_formula(cell) for cell in line] for line in (head, *lines))
    csv.writer(file, lineterminator="\n").writerows(inert)
    return file.getvalue()


def _no_formula(cell: str) -> str:
    """A cell that no spreadsheet runs as a formula; numbers stay as they are."""
    cell = re.sub(r"[\t\r\n]+", " ", cell)
    if cell[:1] in tuple("=+-@"):
        try:
            float(cell)
        except ValueError:
            return f"'{cell}"
    return cell


def file_name(text: str) -> str:
    """Text as the name of a file, which never leads to another folder."""
    return re.sub(r"[^\w+= .-]", "-", text).lstrip(".") or "unnamed"


def to_markdown(table: Table) -> str:
    """A table of GitHub's Markdown, with intervals in brackets."""
    return _rendered("table.md.j2", table)


def to_latex(table: Table) -> str:
    r"""A ``tabular`` with booktabs, in the layout that papers have.

    Intervals are left out; a score that is worse out of distribution has an arrow. To be
    ``\input`` by a document with the packages booktabs, multirow and xcolor.
    """
    return _rendered("table.tex.j2", table)


def templates(**settings: Any) -> Any:
    """Jinja's environment of the report's templates."""
    settings |= {"loader": PackageLoader("acwm_core.report"), "undefined": StrictUndefined}
    return Environment(trim_blocks=True, lstrip_blocks=True, **settings)


def _rendered(template: str, table: Table) -> str:
    """By a template of text that is not HTML, whose marks are none of LaTeX's."""
    made = templates(
        keep_trailing_newline=True,
        block_start_string="<%",
        block_end_string="%>",
        variable_start_string="<<",
        variable_end_string=">>",
    )
    made.filters.update(latex=_escaped, pipes=_in_markdown)
    return made.get_template(template).render(table=table)


def _in_markdown(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|").replace("<", "&lt;")


_LATEX = {
    "\\": r"\textbackslash{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "×": r"$\times$",
    "⁻³": r"$^{-3}$",
    MINUS: r"$-$",
    "≈": r"$\approx$",
    "·": r"$\cdot$",
    "°": r"$^\circ$",
    "Δ": r"$\Delta$",
    "’": "'",
    "–": "--",
    INFINITE: r"$\infty$",
    "…": r"\ldots{}",
}
_SPECIAL = re.compile("|".join(map(re.escape, _LATEX)))


def _escaped(text: str) -> str:
    return _SPECIAL.sub(lambda match: _LATEX[match[0]], text)
