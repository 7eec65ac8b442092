"""Tables as CSV, Markdown and LaTeX, and the templates of pages."""

from __future__ import annotations

import csv
import io
import re
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from acwm_report.table import INFINITE, MINUS, MISSING, Table


def to_csv(table: Table) -> str:
    """Comma-separated values at full precision, with the ends of intervals in their own columns.

    Numbers are in the metrics' own units, not scaled as in the report. Missing values are empty.
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
    """Escape a cell so that no spreadsheet runs it as a formula; numbers stay as they are."""
    cell = re.sub(r"[\t\r\n]+", " ", cell)
    if cell[:1] in tuple("=+-@"):
        try:
            float(cell)
        except ValueError:
            return f"'{cell}"
    return cell


def file_name(text: str) -> str:
    """Turn text into a file name that never leads to another folder."""
    return re.sub(r"[^\w+= .-]", "-", text).lstrip(".") or "unnamed"


def to_markdown(table: Table) -> str:
    """A table in GitHub Markdown, with intervals in brackets."""
    return _rendered("table.md.j2", table)


def to_latex(table: Table) -> str:
    r"""A LaTeX ``tabular`` with booktabs, in the usual layout of papers.

    Intervals are left out; a score that is worse out of distribution has an arrow. Use ``\input``
    in a document that loads the packages booktabs, multirow and xcolor.
    """
    return _rendered("table.tex.j2", table)


def templates(**settings: Any) -> Any:
    """The Jinja environment for the report's templates."""
    settings |= {"loader": PackageLoader("acwm_report"), "undefined": StrictUndefined}
    return Environment(trim_blocks=True, lstrip_blocks=True, **settings)


def _rendered(template: str, table: Table) -> str:
    """Render a text template (not HTML). Its delimiters do not clash with LaTeX."""
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
