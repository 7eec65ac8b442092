"""What this package registers with acwm. A component is imported only when it is used."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_environments(registry: Registry) -> None:
    """Add the environment."""
    registry.add(
        "pendulum",
        "acwm_pendulum.pendulum:Pendulum",
        summary="a pendulum driven by a torque",
        tasks={"hold": "acwm_pendulum.task:HOLD"},
    )


@hookimpl
def register_metrics(registry: Registry) -> None:
    """Add the metric."""
    registry.add(
        "angle_error",
        "acwm_pendulum.angle_error:AngleError",
        summary="degrees between the true angle and the one seen in the prediction",
    )
