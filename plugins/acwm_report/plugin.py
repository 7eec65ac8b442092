"""Register the commands that report and compare evaluated runs."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm report`, `acwm compare` and `acwm leaderboard`."""
    registry.add(
        "report",
        "acwm_report.commands:report",
        summary="write the report of evaluated runs",
        after="evaluate",
    )
    registry.add(
        "compare",
        "acwm_report.commands:compare",
        summary="test which runs differ significantly",
        after="report",
    )
    registry.add(
        "leaderboard",
        "acwm_report.commands:leaderboard",
        summary="collect the results of many runs in one page",
        after="compare",
    )
