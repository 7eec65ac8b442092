"""Tables of numbers in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


_WRAPPED = 14
"""Width of the column of names that wrap."""


def plain_table(title: str | None, first: str, numbers: Sequence[str]) -> Table:
    """A table without lines: a column of names and columns of numbers; cells never wrap.

    Print it by `print_table` if it may be wider than a terminal.
    """
    from rich.table import Table

    table = Table(box=None, title=title, title_justify="left", title_style="bold")
    table.add_column(first, no_wrap=True)
    for heading in numbers:
        table.add_column(heading.replace(" ", "\n"), justify="right", no_wrap=True)
    return table


def print_table(
    console: Console,
    title: str | None,
    numbers: Sequence[str],
    rows: Sequence[tuple[str, Sequence[str]]],
    *,
    first: str = "",
    close: bool = False,
) -> None:
    """Print a `plain_table`; columns that do not fit beside the others follow below them.

    Args:
        console: where to.
        title: its title.
        numbers: headings of the columns of numbers.
        rows: a name, and a cell for each column.
        first: heading of the column of names.
        close: whether columns stand as close to each other as they can, and names wrap if the table
            is wider than the terminal without that.
    """
    from rich.measure import Measurement

    def table(columns: Sequence[int], title: str | None, wraps: bool) -> Table:
        grid = plain_table(title, first, [numbers[column] for column in columns])
        grid.columns[0].no_wrap, grid.columns[0].overflow = False, "fold"  # a name is never cut
        if close:
            grid.padding, grid.pad_edge = (0, 1, 0, 0), False
            grid.columns[0].max_width = _WRAPPED if wraps else None
        for name, cells in rows:
            grid.add_row(name, *(cells[column] for column in columns))
        return grid

    def fits(columns: Sequence[int], wraps: bool) -> bool:
        unbounded = console.options.update(max_width=10_000)
        return Measurement.get(console, unbounded, table(columns, None, wraps)).maximum <= width

    left, width = list(range(len(numbers))), console.width
    wraps = close and not fits(left, False)
    while left:
        fitting = left[:1]
        while len(fitting) < len(left):
            if not fits(left[: len(fitting) + 1], wraps):
                break
            fitting = left[: len(fitting) + 1]
        console.print(table(fitting, title if fitting[0] == 0 else None, wraps))
        left = left[len(fitting) :]
