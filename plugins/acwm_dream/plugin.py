"""Registers the environment made from a model, and `acwm rollout`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_gymnasium_environments(registry: Registry) -> None:
    """Add ``acwm/dream-v0``."""
    registry.add(
        "dream",
        "acwm_dream.environment:Dream",
        summary="an environment made of a world model: run=RUN, task=TASK",
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm rollout`, after the commands that measure how good a model is."""
    registry.add(
        "rollout", "acwm_dream.commands:rollout", summary="predict one video", after="rank"
    )
