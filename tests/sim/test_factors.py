"""Values of factors that worlds refuse; that others are seen and labelled is what checks try."""

import functools

import pytest

from acwm_core.data.simulate import make_environment
from acwm_core.errors import RecipeError

IMPOSSIBLE = [
    ("push_cube", {"friction": -0.1}, "give 0 to 5"),
    ("push_cube", {"mass": 0.0}, "give 0.005 to 10"),
    ("push_cube", {"cube_size": 0.15, "cube_count": 5}, "5 cubes of 0.15 m do not fit"),
    ("stack_cube", {"cube_size": 0.2}, "give 0.02 to 0.075"),
    ("push_rope", {"length": 9.0}, "factors.length=9: give 1 to 3.3"),
    ("push_rope", {"stiffness": 9.0}, "factors.stiffness=9: give"),
    ("push_rope", {"friction": 9.0}, "factors.friction=9: give"),
    ("push_rope", {"thickness": 9.0}, "factors.thickness=9: give"),
    ("cloth_move", {"density": 0.0}, "give 0.02 to 5"),
    ("push_sand", {"board_width": 2.0}, "give 0.05 to 0.7"),
    ("pour_water", {"container_radius": -1.0}, "give 0.35 to 0.95"),
    ("reacher", {"forearm_length": 0.9}, "give 0.1 to 0.53 m"),
    ("reacher", {"forearm_mass": 0.0}, "a mass must be positive"),
    ("reacher", {"damping": -1.0}, "cannot be negative"),
    ("robot_arm", {"obstacle_height": 2.0}, "give 0.02 to 0.6 m"),
    ("robot_arm", {"servo_lag": -1.0}, "give 0 to 1 s"),
    ("robot_arm", {"motor_strength": 0.0}, "motors need some torque"),
]


@functools.cache
def world(name):
    return make_environment(name, {"size": 16})


@pytest.mark.parametrize(("name", "factors", "sentence"), IMPOSSIBLE)
def test_impossible_values_are_refused(name, factors, sentence):
    with pytest.raises(RecipeError, match=sentence):
        world(name).reset(options={"factors": factors})
