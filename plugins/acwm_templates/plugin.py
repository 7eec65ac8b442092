"""Registers the command."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command."""
    registry.add(
        "new",
        "acwm_templates.commands:new",
        summary="start your own plugin",
        after="check",
    )
