"""Markdown of generated pages: cells and tables that nothing can break."""

from collections.abc import Iterable, Sequence


def cell(text: str) -> str:
    """Text on one line, safe in a table."""
    return " ".join(text.replace("``", "`").split()).replace("|", "\\|").replace("<", "&lt;")


def code(text: str) -> str:
    """Code in a table; a dash for none."""
    one = " ".join(text.split()).replace("|", "\\|")
    return f"`{one}`" if one else "–"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, or nothing if it has no rows."""
    found = list(rows)
    lines = [head, ["---"] * len(head), *found]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) if found else ""
