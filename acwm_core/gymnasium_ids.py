"""Gymnasium ids ``acwm/NAME-v0`` for every registered environment.

Gymnasium calls `register` through its entry-point group ``gymnasium.envs`` under the namespace
``acwm``; nothing but the catalog is imported then.
"""

import functools
from typing import Any

import gymnasium

from acwm_core.catalog import catalog


def register() -> None:
    """Register every environment of the catalog with Gymnasium, lazily."""
    for part in catalog().registry("environment"):
        # Environments truncate themselves at their card's horizon, so no TimeLimit is needed.
        gymnasium.register(  # pyright: ignore[reportUnknownMemberType]
            id=f"{part.name}-v0", entry_point=functools.partial(_make, part.name)
        )


def _make(name: str, **params: Any) -> Any:
    return catalog().create("environment", name, **params)
