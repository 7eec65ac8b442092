"""pour_water as a user meets it: policy, splits, ground truth."""

import numpy as np
import pytest

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation
from acwm_particle.cup import THICKNESS
from acwm_particle.physics import CONTAINER, POUR_WATER
from acwm_particle.pour_water import PourWater
from acwm_particle.states import WATER_RECORDED
from acwm_particle.water_drawing import CONTAINER_ID, CUP_ID, HOLDER_ID, WATER_ID
from tests.sim.playing import start, undrawn

pytestmark = pytest.mark.ci


@pytest.fixture(scope="module")
def unseen():
    return undrawn(PourWater)(size=16)


@pytest.fixture(scope="module")
def played(unseen):
    return [simulate(unseen, EpisodeSpec("pour_water", "ind_test", index)) for index in range(2)]


def test_the_policy_pours_most_of_the_water_without_spilling(played):
    for episode in played:
        shares = episode.states["water_share"]
        assert shares[0, 0] == 1
        assert (shares[:20, 2] == 0).all()
        assert shares[-1, 1] > 0.7
        assert shares[-1, 2] < 0.03


def test_episodes_differ_and_have_pauses(played):
    first, second = (episode.actions for episode in played)
    assert np.abs(first - second).max() > 0.02
    for episode in played:
        assert 0 < (np.abs(episode.actions[:-1]).max(1) == 0).mean() < 0.6


def test_water_touches_cup_and_container(played):
    for episode in played:
        pairs = {tuple(row) for row in episode.contacts[:, 1:].tolist()}
        assert {(CUP_ID, WATER_ID), (CONTAINER_ID, WATER_ID)} <= pairs


def test_actions_move_the_target_and_the_cup_follows(played):
    for episode in played:
        target, pose = episode.states["cup_target"], episode.states["cup_pose"]
        asked, moved = episode.actions[:-1], np.diff(target, axis=0)
        assert (np.abs(moved - asked).max(1) < 1e-5).mean() > 0.9  # but for bounds and obstacles
        assert np.abs(target - pose).max() < 0.6
        velocity = episode.states["cup_velocity"]
        mean = np.diff(pose.astype(float), axis=0) * 10
        assert np.abs(mean - (velocity[1:] + velocity[:-1]) / 2)[:, :3].mean() < 0.03


@pytest.mark.parametrize("index", range(4))
def test_out_of_distribution_is_much_lower_or_higher_and_never_overfilled(unseen, index):
    _, info = start(unseen, "ood_test", index)
    level = info["factors"]["water_level"]
    assert level < 0.33 or level > 0.85
    assert info["ood_label"] == "water_level"
    assert info["state"]["water_share"].tolist() == [1, 0, 0]
    assert info["state"]["water_speed"] < 0.1


def test_fewer_particles_than_recorded_repeat(unseen):
    _, info = start(unseen, water_level=0.1)
    count = int(info["state"]["water_count"][0])
    assert count < WATER_RECORDED
    position = info["state"]["water_position"]
    np.testing.assert_array_equal(position[count:], position[: WATER_RECORDED - count])


def test_masks_show_everything():
    env = PourWater(size=128)
    frame, info = start(env)
    shown = {k: (info["mask"] == k).sum() for k in (CUP_ID, CONTAINER_ID, WATER_ID, HOLDER_ID)}
    assert min(shown.values()) > 100
    red, _, blue = frame[info["mask"] == WATER_ID].mean(0)
    assert blue > red + 40


def test_a_full_cup_that_is_stopped_short_keeps_its_water(unseen):
    spec = EpisodeSpec("pour_water", "ood_test", 62)  # it falls on the container's rim
    states = simulate(unseen, spec, frames=124).states
    fall = np.abs(states["cup_velocity"][:, 2]).max()
    assert fall > 0.6
    assert states["water_speed"].max() < 2 * fall  # it was 3 m/s, out of nothing
    assert states["water_share"][-1, 0] > 0.95


def test_the_level_in_the_container_is_where_its_topmost_water_is(played):
    (level,) = POUR_WATER.levels
    for episode in played:
        heights = level.measure(Observation(episode.masks, episode.states), {})
        assert heights.shape == (len(episode.video), 1)
        off = episode.states["water_position"][-1] - episode.states["container_position"][-1]
        inside = off[
            (np.hypot(off[:, 0], off[:, 1]) < CONTAINER.inner) & (off[:, 2] < CONTAINER.tall)
        ]
        surface = np.quantile(inside[:, 2], 0.9) - THICKNESS
        assert heights[-1, 0] > 0.05
        assert heights[-1, 0] == pytest.approx(surface, abs=0.04)
