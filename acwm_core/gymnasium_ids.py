"""Gymnasium ids ``acwm/NAME-v0`` for every registered environment.

Importing this module registers them, as is the custom since Gymnasium 1.0, which has no entry
points any more; `import acwm` does it. Nothing but the catalog is imported then.
"""

import functools
from typing import Any

import gymnasium

from acwm_core.catalog import catalog


def register() -> None:
    """Register every environment of the catalog that has no Gymnasium id yet, lazily."""
    for component in catalog().registry("environment"):
        name = f"acwm/{component.name}-v0"
        if name not in gymnasium.registry:
            # Environments truncate themselves at their card's horizon, so no TimeLimit is needed.
            gymnasium.register(  # pyright: ignore[reportUnknownMemberType]
                id=name, entry_point=functools.partial(_make, component.name)
            )


def _make(name: str, **params: Any) -> Any:
    return catalog().create("environment", name, **params)


register()
