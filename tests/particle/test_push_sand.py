"""push_sand as a user meets it: policy, splits, ground truth."""

import numpy as np
import pytest

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_particle.push_sand import RADIUS, PushSand, height_map
from acwm_particle.sand_drawing import BOARD_ID, SAND_ID
from acwm_particle.sand_layout import DOUBLED, GRAINS
from acwm_particle.states import GRAINS_RECORDED
from tests.sim.playing import start, undrawn

pytestmark = pytest.mark.ci


@pytest.fixture(scope="module")
def unseen():
    return undrawn(PushSand)(size=(24, 40))


@pytest.fixture(scope="module")
def played(unseen):
    return [simulate(unseen, EpisodeSpec("push_sand", "ind_test", index)) for index in range(2)]


def test_the_policy_moves_sand_in_every_episode(played):
    for episode in played:
        rows = episode.contacts
        frames = rows[(rows[:, 1] == SAND_ID) & (rows[:, 2] == BOARD_ID), 0]
        assert len(frames) > 0.25 * len(episode.video)
        moved = np.ptp(episode.states["sand_height"].astype(float), axis=0)
        assert (moved > RADIUS).sum() > 40


def test_episodes_begin_with_settled_sand(played):
    for episode in played:
        grains = episode.states["grain_position"].astype(float)
        # The board starts beside the sand, so that at first nothing but the board moves.
        assert np.median(np.linalg.norm(grains[1] - grains[0], axis=1)) < 0.2 * RADIUS


def test_sand_stays_on_the_table_and_above_it(played):
    for episode in played:
        grains = episode.states["grain_position"].astype(float)
        assert np.isfinite(grains).all()
        assert grains[..., 2].min() > 0.85 * RADIUS  # float16 rounds
        assert (np.abs(grains[..., :2]) < [1.0, 0.8]).mean() > 0.99


def test_actions_are_the_motion_of_the_board(played):
    for episode in played:
        place = episode.states["board_position"].astype(float)
        moved, asked = np.diff(place, axis=0), episode.actions[:-1, :3]
        np.testing.assert_allclose(moved[:, :2], asked[:, :2], atol=1e-5)
        # A board that turns near the ground is kept above it.
        low = place[1:, 2] < 0.12
        np.testing.assert_allclose(moved[~low, 2], asked[~low, 2], atol=1e-5)
        velocity = episode.states["board_velocity"][1:]
        np.testing.assert_allclose(velocity, np.diff(place, axis=0) * 10, atol=1e-4)


def test_out_of_distribution_has_twice_the_grains(unseen):
    _, train = start(unseen)
    _, ood = start(unseen, "ood_test")
    assert train["state"]["grain_count"] == GRAINS
    assert ood["state"]["grain_count"] == DOUBLED
    assert ood["ood_label"] == f"grain_count={DOUBLED}"
    assert ood["state"]["sand_height"].sum() > 1.5 * train["state"]["sand_height"].sum()


def test_the_recorded_grains_stand_for_all(unseen):
    start(unseen, index=1)
    grains = unseen.simulation.grains
    np.testing.assert_allclose(grains[:GRAINS_RECORDED].mean(0), grains.mean(0), atol=0.01)


def test_the_height_map_is_the_top_of_the_sand():
    grains = np.array([[0.01, 0.01, 0.05], [0.012, 0.012, 0.09], [5.0, 0.0, 0.5]], np.float32)
    heights = height_map(grains, 0.01).astype(float)
    row, column = np.unravel_index(heights.argmax(), heights.shape)
    assert (row, column) == (12, 20)
    assert heights.max() == pytest.approx(0.10, abs=1e-3)
    assert (heights > 0).sum() == 1


def test_masks_show_sand_and_board():
    env = PushSand()
    frame, info = start(env)
    sand, board = info["mask"] == SAND_ID, info["mask"] == BOARD_ID
    assert frame.shape == (240, 400, 3)
    assert sand.mean() > 0.05
    assert board.sum() > 300
    red, green, blue = frame[sand].mean(0)
    assert red > green > blue  # sand is yellow
