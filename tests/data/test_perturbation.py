"""Perturbed starts of every installed environment: close, physical, the same way every time."""

import numpy as np
import pytest

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.environment import Environment
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import RecipeError
from tests.core.test_environment import Point

MOVED = {
    "push_cube": ("cube_position", "pusher_position"),
    "stack_cube": ("cube_position", "hand_position"),
    "reacher": ("joint_angle",),
    "robot_arm": ("joint_position",),
    "push_rope": ("rope_position", "pole_position"),
    "cloth_move": ("gripper_position",),
    "push_sand": ("sand_center", "board_position"),
    "pour_water": ("water_center", "cup_pose"),
}
"""What a perturbation moves, in metres or radians."""


def start(environment, index, amount):
    spec = EpisodeSpec(environment.card.name, "ind_test", index)
    return environment.reset(options={"spec": spec, "perturbation": amount})[1]["state"]


@pytest.mark.parametrize("name", MOVED)
def test_an_amount_of_one_is_a_millimetre_or_a_milliradian(name):
    environment = make_environment(name, {"size": 64})
    assert environment.can_be_perturbed
    starts = [[start(environment, k, amount) for amount in (0.0, 1.0)] for k in range(2)]
    for field in MOVED[name]:
        moves = [np.ravel(moved[field] - usual[field]) for usual, moved in starts]
        size = np.sqrt(np.mean(np.concatenate(moves) ** 2))
        assert 1e-4 < size < 3e-3, field


@pytest.mark.parametrize("amount", [-1.0, float("nan"), float("inf"), "much"])
def test_impossible_amounts_are_refused(amount):
    environment = make_environment("reacher", {"size": 64})
    with pytest.raises(RecipeError, match="give 0 or a positive number"):
        environment.reset(options={"perturbation": amount})


def test_an_environment_without_a_perturbed_start_says_so():
    point: Environment = Point()
    assert not point.can_be_perturbed
    point.reset(options={"perturbation": 0.0})
    with pytest.raises(RecipeError, match="no perturbed start"):
        point.reset(options={"perturbation": 1.0})


def test_crowded_cubes_never_start_inside_of_one_another():
    environment = make_environment("push_cube", {"size": 64})
    for index in range(8):
        factors = {"cube_count": 5}
        spec = EpisodeSpec("push_cube", "ind_test", index, factors=factors)
        environment.reset(options={"spec": spec, "perturbation": 20.0})
        assert not environment.simulation.touching


def test_a_rope_and_a_cloth_are_neither_stretched_nor_bent():
    for name, field in (("push_rope", "rope_position"), ("cloth_move", "cloth_position")):
        environment = make_environment(name, {"size": 64})
        usual, moved = (np.float64(start(environment, 0, amount)[field]) for amount in (0.0, 10.0))
        lengths = [np.linalg.norm(np.diff(each, axis=0), axis=-1) for each in (usual, moved)]
        assert np.abs(usual - moved).max() > 1e-3
        np.testing.assert_allclose(*lengths, atol=1e-3 if name == "cloth_move" else 1e-6)


def test_water_moves_with_its_cup():
    environment = make_environment("pour_water", {"size": 64})
    usual, moved = (start(environment, 0, amount) for amount in (0.0, 10.0))
    shift = moved["cup_pose"][:3] - usual["cup_pose"][:3]
    np.testing.assert_allclose(moved["water_center"] - usual["water_center"], shift, atol=4e-3)
    assert moved["water_share"][0] == usual["water_share"][0]


def test_a_still_pusher_stays_where_it_is():
    environment = make_environment("push_cube", {"size": 64})
    spec = EpisodeSpec("push_cube", "ind_test", 0)
    environment.reset(options={"spec": spec})
    still = np.tile(environment.still_action(), (12, 1))
    places = simulate(environment, spec, still, frames=12).states["pusher_position"]
    assert np.abs(places - places[0]).max() < 1e-4


def test_a_few_frames_are_the_beginning_of_the_episode():
    environment = make_environment("reacher", {"size": 64})
    spec = EpisodeSpec("reacher", "ind_test", 3)
    whole = simulate(environment, spec)
    few = simulate(environment, spec, whole.actions[:9], frames=9)
    assert np.array_equal(few.video, whole.video[:9])
    assert np.array_equal(few.actions[:-1], whole.actions[:8])
    assert not few.actions[-1].any()
