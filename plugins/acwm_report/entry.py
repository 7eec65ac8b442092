"""The card of an entry: who predicted, what with, and after which training; ``entry.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import yaml

from acwm_core.errors import DataError, suggest
from acwm_core.evaluation.results import Summary
from acwm_core.files import inside, typed

ENTRY = "entry.yaml"


@dataclass(frozen=True)
class Entry:
    """What the authors of an entry say of it.

    Attributes:
        name: its name; that of the folder by default.
        url: where to read more, https or http.
        parameters: number of trained parameters.
        data: what it was trained on, in words.
        compute: what training took, in words.
    """

    name: str
    url: str = ""
    parameters: int | None = None
    data: str = ""
    compute: str = ""


def read_entry(folder: Path) -> Entry:
    """Read ``entry.yaml`` of a folder of predictions, or of a run; only a name if there is none.

    Raises:
        DataError: it is no such card.
    """
    path = inside(folder, ENTRY)
    if not path.is_file():
        return Entry(folder.resolve().name)
    try:
        values = cast(dict[str, Any], yaml.safe_load(path.read_text(encoding="utf-8")) or {})
        known = [each.name for each in fields(Entry)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown {name!r}{suggest(str(name), known)}")
        return _checked(typed({"name": folder.resolve().name, **values}, Entry))
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        why = " ".join(str(error).split())
        raise DataError(f"{path} is no card of an entry ({why})") from error


def entry_of(run: Path, summary: Summary) -> Entry:
    """The card of an evaluated folder.

    Raises:
        DataError: its card is damaged.
    """
    if summary.handed_in:
        return _checked(typed(summary.provenance["entry"], Entry))
    return read_entry(run)


def _checked(entry: Entry) -> Entry:
    if entry.url and not entry.url.startswith(("https://", "http://")):
        raise DataError(f"the url of an entry, {entry.url!r}, does not begin with https://")
    return entry
