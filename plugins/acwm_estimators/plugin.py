"""Registers an estimator for every environment whose weights ship with the package."""

from acwm_core.plugins import Registry, hookimpl

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
"""Environments on which networks were trained; also the names of weights, layouts and limits."""

WEIGHTS = {name: name for name in TRAINED} | {
    "push_cube_4cube": "push_cube",
    "cloth_move_8d": "cloth_move",
}
"""The name of the weights for each environment; variants that look alike share weights."""


@hookimpl
def register_estimators(registry: Registry) -> None:
    """Register one estimator per environment, under the environment's name."""
    for name in sorted(WEIGHTS):
        registry.add(
            name,
            "acwm_estimators.estimator:Estimator",
            summary="masks and states from frames, by a small network with shipped weights",
        )


@hookimpl
def register_commands(registry: Registry) -> None:
    """Add the command that trains an estimator of one's own world."""
    registry.add(
        "train-estimator",
        "acwm_estimators.commands:train_estimator",
        summary="train a network that reads the states of your own world",
    )
