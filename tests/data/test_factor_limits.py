"""Values that a simulator cannot take are refused in a sentence, before anything is simulated."""

import pytest

from acwm_core.data.simulate import make_environment
from acwm_core.errors import RecipeError

IMPOSSIBLE = [
    ("push_cube", {"friction": -0.1}, "give 0 to 5"),
    ("push_cube", {"mass": 0.0}, "give 0.005 to 10"),
    ("push_cube", {"cube_size": 0.15, "cube_count": 5}, "5 cubes of 0.15 m do not fit"),
    ("stack_cube", {"cube_size": 0.2}, "give 0.02 to 0.075"),
    ("push_rope", {"length": 9.0}, "give 1 to 3.3"),
    ("cloth_move", {"density": 0.0}, "give 0.02 to 5"),
    ("push_sand", {"board_width": 2.0}, "give 0.05 to 0.7"),
    ("pour_water", {"container_radius": -1.0}, "give 0.35 to 0.95"),
    ("reacher", {"forearm_mass": 0.0}, "must be positive"),
    ("robot_arm", {"servo_lag": -1.0}, "give 0 to 1 s"),
]


@pytest.mark.parametrize(("name", "factors", "sentence"), IMPOSSIBLE)
def test_impossible_values_are_refused(name, factors, sentence):
    environment = make_environment(name, {"size": 64})
    with pytest.raises(RecipeError, match=sentence):
        environment.reset(options={"factors": factors})
