"""A table as data, and as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from acwm_core.evaluation.results import Estimate
from acwm_core.report.wording import MINUS, MISSING, Scale

WORSE = "worse"
"""Mark of a score that is worse out of distribution than in distribution."""


@dataclass(frozen=True)
class Cell:
    """A number and, small below it, its interval.

    Attributes:
        text: the number as it is read.
        interval: its 95 % confidence interval, as it is read.
        value: the number itself, neither scaled nor rounded; None for words and gaps.
        low: lower end of the interval.
        high: upper end.
        mark: ``"worse"``, or empty.
        link: an id on the page that the cell leads to, or empty.
    """

    text: str
    interval: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    mark: str = ""
    link: str = ""

    @classmethod
    def of(cls, estimate: Estimate, scale: Scale, *, signed: bool = False, mark: str = "") -> Cell:
        """An estimate, written with its scale."""
        text = scale.number(estimate.value, signed=signed)
        interval = scale.interval(estimate, signed=signed)
        return cls(text, interval, estimate.value, estimate.low, estimate.high, mark)


@dataclass(frozen=True)
class Column:
    """The head of a column.

    Attributes:
        title: as it is read.
        unit: of the numbers as they are written, or empty.
        better: which way is: ``"↑"``, ``"↓"`` or empty.
        group: columns of one group stand under a common heading.
        key: the column's name in CSV, where numbers have the metric's own unit; the title by
            default.
    """

    title: str
    unit: str = ""
    better: str = ""
    group: str = ""
    key: str = ""


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        title: in the first column.
        note: small below it.
        colour: CSS variable of its swatch, or ``""``.
        cells: one per column.
        strong: set off from the others.
        group: rows of one group stand together under its name.
        quiet: set back, as a figure that is quoted beside the others.
        link: an id on the page that the title leads to, or empty.
    """

    title: str
    note: str
    colour: str
    cells: list[Cell]
    strong: bool = False
    group: str = ""
    quiet: bool = False
    link: str = ""


@dataclass(frozen=True)
class Table:
    """A table with its heading.

    Attributes:
        title: above it.
        columns: all but the first.
        rows: in order.
        corner: head of the first column.
        caption: what a reader must know, below it.
        name: of the files that it is exported to.
    """

    title: str
    columns: list[Column]
    rows: list[Row]
    corner: str = ""
    caption: str = ""
    name: str = ""

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings over the columns, and how many columns each spans; empty without groups."""
        spans = [(g, len(list(c))) for g, c in itertools.groupby(self.columns, lambda c: c.group)]
        return spans if any(group for group, _ in spans) else []


def to_csv(table: Table) -> str:
    """Comma-separated values at full precision, with the ends of intervals in their own columns.

    Numbers are in the metrics' own units, not in thousandths; gaps are empty.
    """
    bounded = [
        any(row.cells[k].low is not None for row in table.rows) for k in range(len(table.columns))
    ]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    head = ["group"] * any(row.group for row in table.rows) + [table.corner or "row", "note"]
    for column, interval in zip(table.columns, bounded, strict=True):
        key = column.key or " ".join(filter(None, (column.group, column.title)))
        head += [key, f"{key}_low", f"{key}_high"] if interval else [key]
    writer.writerow(head)
    for row in table.rows:
        line: list[str] = [row.group] * ("group" in head[:1]) + [row.title, row.note]
        for cell, interval in zip(row.cells, bounded, strict=True):
            line.append(_exact(cell))
            if interval:
                line += [_number(cell.low), _number(cell.high)]
        writer.writerow(line)
    return file.getvalue()


def _exact(cell: Cell) -> str:
    if cell.value is None:
        return "" if cell.text == MISSING else cell.text
    return _number(cell.value)


def _number(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def to_markdown(table: Table) -> str:
    """A table of GitHub's Markdown, with intervals in brackets."""
    heads = [
        " ".join(filter(None, (column.group, column.title + column.better, column.unit)))
        for column in table.columns
    ]
    lines = [f"**{_pipes(table.title)}**\n"] if table.title else []
    lines.append(_line([table.corner, *heads]))
    lines.append(_line([":--", *["--:"] * len(heads)]))
    for row in table.rows:
        cells = [
            cell.text + (" ▼" if cell.mark else "") + (f" [{cell.interval}]" * bool(cell.interval))
            for cell in row.cells
        ]
        title = " · ".join(filter(None, (row.group, row.title)))
        lines.append(_line([f"**{title}**" if row.strong else title, *cells]))
    if table.caption:
        lines.append(f"\n{table.caption}")
    return "\n".join(lines) + "\n"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(map(_pipes, cells))} |"


def _pipes(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


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
    "…": r"\ldots{}",
}
_SPECIAL = re.compile("|".join(map(re.escape, _LATEX)))


def escape_latex(text: str) -> str:
    """Text for LaTeX."""
    return _SPECIAL.sub(lambda match: _LATEX[match[0]], text)


def to_latex(table: Table) -> str:
    r"""A ``tabular`` with booktabs, in the layout of the paper's tables.

    Intervals are left out; a score that is worse out of distribution has an arrow. To be
    ``\input`` by a document with the packages booktabs, multirow and xcolor.
    """
    grouped = any(row.group for row in table.rows)
    lead = 1 + grouped
    spec = "l" * lead + "".join(
        " " * bool(index) + "c" * count
        for index, (_, count) in enumerate(table.groups or [("", len(table.columns))], start=1)
    )
    title = escape_latex(table.title or table.name)
    lines = [f"% {title}; needs \\usepackage{{booktabs,multirow,xcolor}}"]
    lines += [f"\\begin{{tabular}}{{{spec}}}", "\\toprule", *_latex_groups(table, lead)]
    heads = [
        escape_latex(c.title + c.better + f" ({c.unit})" * bool(c.unit)) for c in table.columns
    ]
    corner = escape_latex(table.corner)
    lines.append(_latex_line([*[""] * grouped, f"\\textbf{{{corner}}}" if corner else "", *heads]))
    for group, rows in itertools.groupby(table.rows, lambda row: row.group):
        lines += ["\\midrule", *_latex_rows(group, list(rows), grouped)]
    lines += ["\\bottomrule", "\\end{tabular}"]
    return "\n".join(lines) + "\n"


def _latex_groups(table: Table, lead: int) -> list[str]:
    if not table.groups:
        return []
    heads, rules, first = [""] * lead, list[str](), lead + 1
    for group, count in table.groups:
        heads.append(f"\\multicolumn{{{count}}}{{c}}{{\\textbf{{{escape_latex(group)}}}}}")
        if group:
            rules.append(f"\\cmidrule(lr){{{first}-{first + count - 1}}}")
        first += count
    return [_latex_line(heads), "".join(rules)]


def _latex_rows(group: str, rows: Sequence[Row], grouped: bool) -> list[str]:
    lines: list[str] = []
    for index, row in enumerate(rows):
        name = f"\\multirow{{{len(rows)}}}{{*}}{{{escape_latex(group)}}}" if index == 0 else ""
        title = escape_latex(row.title)
        cells = [
            escape_latex(c.text) + ("{\\color{red}$\\downarrow$}" if c.mark else "")
            for c in row.cells
        ]
        title = f"\\textbf{{{title}}}" if row.strong else title
        lines.append(_latex_line([*[name] * grouped, title, *cells]))
    return lines


def _latex_line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + " \\\\"
