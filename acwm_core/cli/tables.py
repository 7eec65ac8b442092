"""Tables of numbers in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


def plain_table(title: str | None, first: str, numbers: Sequence[str]) -> Table:
    """A table without lines: a column of names and columns of numbers; cells never wrap."""
    from rich.table import Table

    table = Table(box=None, title=title, title_justify="left", title_style="bold")
    table.add_column(first, no_wrap=True)
    for heading in numbers:
        table.add_column(heading.replace(" ", "\n"), justify="right", no_wrap=True)
    return table
