"""Register `acwm doctor`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command, listed after `acwm check`."""
    registry.add(
        "doctor", "acwm_doctor.commands:doctor", summary="say what works here", after="check"
    )
