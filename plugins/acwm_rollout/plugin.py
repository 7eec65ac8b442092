"""Registers `acwm rollout`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command, after the commands that measure how good a model is."""
    registry.add(
        "rollout",
        "acwm_rollout.commands:rollout",
        summary="predict one video",
        after="rank",
    )
