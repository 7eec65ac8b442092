"""Registers the command."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command."""
    registry.add(
        "new",
        "acwm_templates.commands:new",
        summary="start a plugin of your own",
        after="check",
    )
