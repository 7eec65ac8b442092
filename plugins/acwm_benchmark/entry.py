"""Who predicted: the card of an entry, ``entry.yaml`` in the folder of predictions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, cast

import yaml

from acwm_core.errors import DataError, suggest
from acwm_core.files import typed

ENTRY = "entry.yaml"


@dataclass(frozen=True)
class Entry:
    """What a participant says of an entry.

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
    """Read the card of the predictions in a folder; only its name, if there is no ``entry.yaml``.

    Raises:
        DataError: it is no such card.
    """
    path = folder / ENTRY
    if not path.is_file():
        return Entry(folder.resolve().name)
    try:
        values = cast(Any, yaml.safe_load(path.read_text(encoding="utf-8"))) or {}
        known = [each.name for each in fields(Entry)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown {name!r}{suggest(str(name), known)}")
        entry = typed({"name": folder.resolve().name, **values}, Entry)
        if entry.url and not entry.url.startswith(("https://", "http://")):
            raise ValueError(f"url: {entry.url!r} does not begin with https://")
    except (OSError, ValueError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise DataError(f"{path} is no card of an entry ({error})") from error
    return entry
