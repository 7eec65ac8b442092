"""Markdown of generated pages: cells and tables that nothing can break."""

from collections.abc import Iterable, Sequence


def cell(text: str) -> str:
    """Text on one line, safe in a table; within backquotes nothing needs to be escaped."""
    parts = " ".join(text.replace("``", "`").split()).split("`")
    plain = [part.replace("|", "\\|").replace("<", "&lt;") for part in parts[::2]]
    return "`".join(plain[k // 2] if k % 2 == 0 else part for k, part in enumerate(parts))


def code(text: str) -> str:
    """Code in a table; a dash for none."""
    return f"`{' '.join(text.split())}`" if text else "–"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, or nothing if it has no rows."""
    found = list(rows)
    lines = [head, ["---"] * len(head), *found]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) if found else ""
