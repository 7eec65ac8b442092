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
    for name, module, summary, after in (
        ("evaluate", "commands", "measure how good a trained model is", "import-checkpoint"),
        ("plan", "planning", "act by planning with a model, in the simulator", "evaluate"),
        ("rank", "planning", "rank policies in a model, and compare with the simulator", "plan"),
        ("policy", "policy", "train a policy in a model, and measure it in the simulator", "rank"),
        ("report", "commands", "write the report of evaluated runs", "evaluate"),
        ("compare", "commands", "test which runs differ significantly", "report"),
        ("leaderboard", "commands", "collect the results of many runs in one page", "compare"),
    ):
        registry.add(name, f"acwm_report.{module}:{name}", summary=summary, after=after)
