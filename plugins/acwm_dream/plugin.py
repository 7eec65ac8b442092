"""Registers the environment made from a model."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_gymnasium_environments(registry: Registry) -> None:
    """Add ``acwm/dream-v0``."""
    registry.add(
        "dream",
        "acwm_dream.environment:Dream",
        summary="an environment made of a world model: run=RUN, task=TASK",
    )
