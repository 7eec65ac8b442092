"""Registers the command."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm play`."""
    registry.add(
        "play",
        "acwm_play.commands:play",
        summary="play in a world: simulator and model side by side",
        after="rollout",
    )
