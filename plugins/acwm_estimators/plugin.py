"""Registers an estimator for every environment for which weights ship with the package."""

from acwm_core.hooks import hookimpl
from acwm_core.registry import Registry

TRAINED = (
    "cloth_move",
    "pour_water",
    "push_cube",
    "push_cube_two_pushers",
    "push_rope",
    "push_sand",
    "reacher",
    "robot_arm",
    "stack_cube",
)
"""Environments on which networks were trained: names of their weights, layouts and limits."""

WEIGHTS = {name: name for name in TRAINED} | {
    "push_cube_4cube": "push_cube",
    "cloth_move_8d": "cloth_move",
}
"""Whose weights each environment is read with: variants that look alike share them."""


@hookimpl
def register_estimators(registry: Registry) -> None:
    """One per environment, under its name."""
    for name in sorted(WEIGHTS):
        registry.add(
            name,
            "acwm_estimators.estimator:Estimator",
            summary="masks and states from frames, by a small network with shipped weights",
        )
