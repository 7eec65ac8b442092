"""Registers `acwm rank`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command."""
    registry.add(
        "rank",
        "acwm_policies.commands:rank",
        summary="rank policies in a model, and compare with the simulator",
        after="plan",
    )
