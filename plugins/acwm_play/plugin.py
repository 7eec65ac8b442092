"""Registers the command."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm play`."""
    registry.add(
        "play",
        "acwm_play.commands:play",
        summary="play in a world: simulator and model side by side",
        after="rollout",
    )
