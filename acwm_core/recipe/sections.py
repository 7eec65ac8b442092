"""The sections of a recipe as they are written in files, before they are checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

COMPONENTS = ("env", "codec", "model", "conditioner", "objective")
"""Sections that hold a component, i.e. a registered name and its parameters."""


def written_out(section: str, value: Any) -> Any:
    """Expand the short form ``model: dit_s``."""
    if section in COMPONENTS and value is not None and not isinstance(value, Mapping):
        return {"name": value}
    return value  # pyright: ignore[reportUnknownVariableType]


def mapping_or_empty(section: Any) -> Mapping[str, Any]:
    """A section, or nothing if it is no mapping, which its check refuses later."""
    return cast(Mapping[str, Any], section) if isinstance(section, Mapping) else {}


def deep_merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of both; where both have a mapping, the entries of both mappings."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = deep_merge(cast(dict[str, Any], old), cast(dict[str, Any], value))
        else:
            merged[key] = value
    return merged
