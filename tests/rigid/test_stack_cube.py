"""stack_cube as a user meets it: success, splits, ground truth, reproducibility."""

import numpy as np
import pytest

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_rigid.stack_cube import DIRECTIONS, SPREAD, StackCube
from acwm_rigid.stack_simulation import ARM_ID, GREEN, GREEN_ID, GRIPPER_ID, RED, RED_ID
from tests.sim.playing import start, undrawn

pytestmark = pytest.mark.ci

EPISODES = 12


@pytest.fixture(scope="module")
def unseen():
    env = undrawn(StackCube)(size=16)
    yield env
    env.close()


@pytest.fixture(scope="module")
def played(unseen):
    return {
        split: [simulate(unseen, EpisodeSpec("stack_cube", split, i)) for i in range(EPISODES)]
        for split in ("ind_test", "ood_test")
    }


def test_the_red_cube_ends_on_the_green_one(played):
    for split, least in (("ind_test", 0.95), ("ood_test", 0.9)):
        ends = [episode.states["stacked"][-1, 0] for episode in played[split]]
        assert np.mean(ends) >= least, split


def test_a_stack_is_one_and_a_half_edges_high_and_at_rest(played):
    for episode in played["ind_test"]:
        if episode.states["stacked"][-1, 0]:
            red, green = episode.states["cube_position"][-1]
            assert red[2] == pytest.approx(0.075, abs=0.002)
            assert green[2] == pytest.approx(0.025, abs=0.001)
            assert np.abs(episode.states["cube_velocity"][-1]).max() < 0.01


def test_directions_are_what_the_factor_says(played):
    for split in played:
        for episode in played[split]:
            red, green = episode.states["cube_position"][0]
            angle = np.degrees(np.arctan2(*(green - red)[1::-1]))
            off = (angle - DIRECTIONS[episode.factors["direction"]] + 180) % 360 - 180
            assert abs(off) <= SPREAD + 0.5


def test_held_out_directions_are_recorded(played):
    assert {episode.ood_label for episode in played["ind_test"]} == {None}
    labels = {episode.ood_label for episode in played["ood_test"]}
    assert labels == {f"direction={way}" for way in ("north", "west", "south", "east")}


def test_episodes_differ_in_manner(played):
    released = [int(np.argmax(e.states["stacked"][:, 0] > 0)) for e in played["ind_test"]]
    assert np.ptp(released) >= 8
    heights = [e.states["cube_position"][:, RED, 2].max() for e in played["ind_test"]]
    assert np.ptp(heights) > 0.02


def test_every_part_of_the_action_is_used(played):
    actions = np.concatenate([episode.actions[:-1] for episode in played["ind_test"]])
    low, high = (np.array(side) for side in (StackCube.card.action.low, StackCube.card.action.high))
    assert ((actions >= low) & (actions <= high)).all()
    assert (np.ptp(actions, axis=0) > 0.3 * (high - low)).all()


def test_the_hand_goes_exactly_where_the_actions_send_it(played):
    for episode in played["ind_test"]:
        sent = episode.states["hand_position"][0] + np.cumsum(episode.actions[:-1, :3], axis=0)
        assert np.linalg.norm(episode.states["hand_position"][1:] - sent, axis=1).max() < 0.004


def test_contacts_tell_the_story(played):
    for episode in played["ind_test"]:
        rows = episode.contacts
        held = rows[(rows[:, 1] == GRIPPER_ID) & (rows[:, 2] == RED_ID), 0]
        stacked = rows[(rows[:, 1] == RED_ID) & (rows[:, 2] == GREEN_ID), 0]
        lifted = np.nonzero(episode.states["cube_position"][:, RED, 2] > 0.05)[0]
        assert held.min() < lifted.min() < stacked.max()
        assert not ((rows[:, 1] == ARM_ID) & (rows[:, 2] == RED_ID)).any()


def test_the_green_cube_stays_where_it_is(played):
    for episode in played["ind_test"]:
        moved = episode.states["cube_position"][:, GREEN, :2]
        assert np.linalg.norm(moved - moved[0], axis=1).max() < 0.02


def test_masks_show_both_cubes_and_the_robot():
    env = StackCube()
    frame, info = start(env, index=1)
    for instance, channel in ((RED_ID, 0), (GREEN_ID, 1)):
        shown = info["mask"] == instance
        assert shown.sum() > 100
        assert (frame[shown].argmax(1) == channel).mean() > 0.95
    assert (info["mask"] == ARM_ID).sum() > 1000
    assert (info["mask"] == GRIPPER_ID).sum() > 300
    env.close()
