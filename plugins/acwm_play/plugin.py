"""Registers the kind driver, one that plans, one of trained policies, and `acwm play`."""

from acwm_core.plugins import Registry, hookimpl


@hookimpl
def register_kinds(registry: Registry) -> None:
    """Add the kind of component that acts in the place of a person."""
    registry.add(
        "driver",
        "acwm_play.driver:Driver",
        summary="solves a task in `acwm play`, from pictures",
    )


@hookimpl
def register_drivers(registry: Registry) -> None:
    """Add the drivers of acwm."""
    registry.add(
        "planner",
        "acwm_play.planning_driver:PlanningDriver",
        summary="plans with the model in play",
    )
    registry.add(
        "trained_policy",
        "acwm_play.policy_driver:PolicyDriver",
        summary="lets a policy of `acwm policy train` act in play",
    )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add `acwm play`."""
    registry.add(
        "play",
        "acwm_play.commands:play",
        summary="play in a world: simulator and model side by side",
        after="rollout",
    )
