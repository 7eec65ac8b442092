"""Register the command that runs experiments."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm experiment`."""
    registry.add(
        "experiment",
        "acwm_experiment.commands:experiment",
        summary="simulate, train, evaluate, plan with and report many runs",
        after="play",
    )
