"""The card of an entry: who predicted, what with, and after which training; ``entry.yaml``."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import yaml

from acwm_core.errors import DataError, suggest
from acwm_core.evaluation.results import Summary
from acwm_core.files import parse_yaml, regular_file, typed

ENTRY = "entry.yaml"

MOST_BYTES = 100_000
MOST_LETTERS = {"name": 100, "url": 500, "data": 1000, "compute": 1000}
MOST_PARAMETERS = 10**15
"""What a page shows of an entry without being filled by it."""


@dataclass(frozen=True)
class Entry:
    """What the authors of an entry say of it.

    Attributes:
        name: its name; that of the folder by default.
        url: where to read more, https or http.
        parameters: number of trained parameters, 0 or more.
        data: what it was trained on, in words.
        compute: what training took, in words.
    """

    name: str
    url: str = ""
    parameters: int | None = None
    data: str = ""
    compute: str = ""

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("its name is empty")
        for name, most in MOST_LETTERS.items():
            text: str = getattr(self, name)
            if len(text) > most or not text.replace("\n", " ").isprintable():
                raise ValueError(f"{name} has more than {most} letters, or some that are not shown")
        if self.parameters is not None and not 0 <= self.parameters <= MOST_PARAMETERS:
            raise ValueError(f"parameters: {self.parameters} is not a number of trained parameters")
        if self.url and not self.url.startswith(("https://", "http://")):
            raise ValueError(f"the url {self.url!r} does not begin with https://")


def read_entry(folder: Path) -> Entry:
    """Read ``entry.yaml`` of a folder of predictions, or of a run; only a name if there is none.

    Raises:
        DataError: it is no such card.
    """
    if not os.path.lexists(folder / ENTRY):
        return Entry(_name_of(folder))
    path = regular_file(folder, ENTRY)
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES:,} bytes")
        content: Any = parse_yaml(path.read_text(encoding="utf-8")) or {}
        if not isinstance(content, dict):
            raise ValueError("it must have lines such as `name: Ours`")
        values = cast(dict[str, Any], content)
        known = [each.name for each in fields(Entry)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown {name!r}{suggest(str(name), known)}")
        return typed({"name": _name_of(folder), **values}, Entry)
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        why = " ".join(str(error).split())[:300]
        raise DataError(f"{path} is not the card of an entry ({why})") from error


def entry_of(run: Path, summary: Summary) -> Entry:
    """The card of an evaluated folder.

    Raises:
        DataError: its card is damaged.
    """
    if summary.handed_in:
        return typed(summary.provenance["entry"], Entry)
    return read_entry(run)


def _name_of(folder: Path) -> str:
    """The name of a folder, as far as a card may hold it."""
    name = folder.resolve().name[: MOST_LETTERS["name"]]
    return name if name.isprintable() and name.strip() else "unnamed"
