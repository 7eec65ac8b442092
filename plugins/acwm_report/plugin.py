"""Register the commands that evaluate runs, act with them, report and compare."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add what measures and shows runs, and `report` to the group `data`."""
    registry.add(
        "data.report",
        "acwm_report.commands:data_report",
        summary="write a page about a dataset",
    )
    registry.add(
        "evaluate",
        "acwm_report.commands:evaluate",
        summary="measure how good a trained model is",
        after="import-checkpoint",
    )
    registry.add(
        "plan",
        "acwm_report.planning:plan",
        summary="act by planning with a model, in the simulator",
        after="evaluate",
    )
    registry.add(
        "rank",
        "acwm_report.planning:rank",
        summary="rank policies in a model, and compare with the simulator",
        after="plan",
    )
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
