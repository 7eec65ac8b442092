"""Registers an estimator for every environment."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry

ENVIRONMENTS = (
    "cloth_move",
    "cloth_move_8d",
    "pour_water",
    "push_cube",
    "push_cube_4cube",
    "push_cube_two_pushers",
    "push_rope",
    "push_sand",
    "reacher",
    "robot_arm",
    "stack_cube",
)


@hookimpl
def register_estimators(registry: Registry) -> None:
    """One per environment, under its name; the weights ship with the package."""
    for name in ENVIRONMENTS:
        registry.add(
            name,
            "acwm_estimators.estimator:Estimator",
            summary="masks and states from frames, by a small network with shipped weights",
        )
