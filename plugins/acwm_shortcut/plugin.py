"""Registers shortcut forcing."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_objectives(registry: Registry) -> None:
    """Add the objective."""
    registry.add(
        "shortcut",
        "acwm_shortcut.shortcut:ShortcutForcing",
        summary="learns long sampling steps from its own short ones; samples in 4 evaluations",
    )
