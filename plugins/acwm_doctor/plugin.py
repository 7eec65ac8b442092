"""Registers `acwm doctor`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command, after that which checks components."""
    registry.add(
        "doctor", "acwm_doctor.commands:doctor", summary="say what works here", after="check"
    )
