"""Registers `acwm policy`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm policy`, after `acwm rank`."""
    registry.add(
        "policy",
        "acwm_policy.commands:policy",
        summary="train a policy in a model, and evaluate it in the simulator",
        after="rank",
    )
