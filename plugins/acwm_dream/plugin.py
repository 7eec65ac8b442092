"""Registers `acwm rollout`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm rollout`, after the commands that measure how good a model is."""
    registry.add(
        "rollout", "acwm_dream.commands:rollout", summary="predict one video", after="rank"
    )
