"""What this package registers with acwm. A component is imported only when it is used."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add the environment and its tasks."""
    registry.add(
        "pusht",
        "acwm_pusht.pusht:PushT",
        summary="a disc that pushes a T onto its place (gym-pusht)",
        tasks={"cover": "acwm_pusht.tasks:COVER", "pose": "acwm_pusht.tasks:POSE"},
    )
