"""Registers `acwm data` and `acwm encode`."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the commands, after `generate`."""
    registry.add(
        "data",
        "acwm_data.commands:data",
        summary="inspect, check, import and export datasets",
        after="generate",
    )
    registry.add(
        "encode",
        "acwm_data.encoding:encode",
        summary="encode the clips of a dataset as latents",
        after="data",
    )
