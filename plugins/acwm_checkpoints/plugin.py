"""Register `acwm import-checkpoint`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command, listed after `acwm fit`."""
    registry.add(
        "import-checkpoint",
        "acwm_checkpoints.commands:import_checkpoint",
        summary="make a run folder of a published checkpoint",
        after="fit",
    )
