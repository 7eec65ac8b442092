"""Register the commands `acwm benchmark` and `acwm score`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `benchmark`, which exports tasks, and `score`."""
    registry.add(
        "benchmark",
        "acwm_benchmark.commands:benchmark",
        summary="export the test clips as tasks for any program",
        after="leaderboard",
    )
    registry.add(
        "score",
        "acwm_benchmark.commands:score",
        summary="score the predictions of any program",
        after="benchmark",
    )
