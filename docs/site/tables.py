"""Markdown tables of generated pages, with escaping."""

from collections.abc import Iterable, Sequence


def cell(text: str) -> str:
    """Text on one line, escaped for a table; nothing is escaped within backquotes."""
    parts = " ".join(text.replace("``", "`").split()).split("`")
    plain = [part.replace("|", "\\|").replace("<", "&lt;") for part in parts[::2]]
    return "`".join(plain[k // 2] if k % 2 == 0 else part for k, part in enumerate(parts))


def code(text: str) -> str:
    """Code in a table cell; a dash if there is none."""
    return f"`{' '.join(text.split())}`" if text else "–"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, or an empty string without rows."""
    found = list(rows)
    lines = [head, ["---"] * len(head), *found]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) if found else ""
