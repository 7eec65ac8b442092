"""reacher as a user meets it: actions, ground truth, policy, splits, reproducibility."""

import numpy as np
import pytest

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_kinematics.physics import MARKER_RADIUS
from acwm_kinematics.reacher import LIMITS, ReacherArm
from acwm_kinematics.reacher_arm import Links
from acwm_kinematics.reacher_drawing import GOAL_ID, INNER, TIP_ID
from acwm_kinematics.reacher_policy import Region, in_corner_sector
from tests.sim.playing import undrawn

EPISODES = 40


@pytest.fixture(scope="module")
def env():
    return ReacherArm(size=64)


@pytest.fixture(scope="module")
def unseen():
    return undrawn(ReacherArm)(size=16)


@pytest.fixture(scope="module")
def episodes(unseen):
    """Episodes of the policy by split."""
    return {
        split: [simulate(unseen, EpisodeSpec("reacher", split, k)) for k in range(EPISODES)]
        for split in ("train", "ood_test")
    }


def misses(episode):
    """Distance of fingertip and goal in every frame, metres."""
    gap = episode.states["fingertip_position"] - episode.states["goal_position"]
    return np.linalg.norm(gap, axis=1)


def run(env, actions, **factors):
    return simulate(env, EpisodeSpec("reacher", "train", 3, factors=factors), actions)


def test_zero_torque_holds_still(env):
    episode = run(env, np.zeros((49, 2), np.float32))
    assert (episode.video == episode.video[0]).all()
    for values in episode.states.values():
        np.testing.assert_array_equal(values, np.broadcast_to(values[0], values.shape))


@pytest.mark.parametrize("joint", [0, 1])
def test_a_positive_torque_turns_its_joint_counter_clockwise(unseen, joint):
    for sign in (1, -1):
        actions = np.zeros((49, 2), np.float32)
        actions[0, joint] = 2.0 * sign
        assert sign * run(unseen, actions).states["joint_velocity"][1, joint] > 0.05


def test_the_mask_shows_every_part_where_the_state_says(env):
    camera = None
    seen = 0
    for index in range(6):
        spec = EpisodeSpec("reacher", "train", index)
        episode = simulate(env, spec)
        camera = env.drawing.scene.camera
        for mask, tip, goal in zip(
            episode.masks[::7],
            episode.states["fingertip_position"][::7],
            episode.states["goal_position"][::7],
            strict=True,
        ):
            assert {1, 2, 3, 4} <= set(np.unique(mask))
            for part, place, height in ((TIP_ID, tip, 0.12), (GOAL_ID, goal, 0.0)):
                rows, columns = np.nonzero(mask == part)
                if len(rows) > 3:
                    x, y, _ = camera.project([*place, height], 64, 64)
                    assert abs(columns.mean() + 0.5 - x) < 3
                    assert abs(rows.mean() + 0.5 - y) < 3.5
                    seen += 1
    assert seen > 40


def test_states_agree_with_each_other(episodes):
    for episode in episodes["train"][:10]:
        states = episode.states
        heading = np.cumsum(states["joint_angle"], axis=1)
        elbow = 0.5 * np.stack([np.cos(heading[:, 0]), np.sin(heading[:, 0])], 1)
        tip = elbow + 0.4 * np.stack([np.cos(heading[:, 1]), np.sin(heading[:, 1])], 1)
        np.testing.assert_allclose(states["elbow_position"], elbow, atol=1e-5)
        np.testing.assert_allclose(states["fingertip_position"], tip, atol=1e-5)
        assert np.abs(states["joint_angle"]).max() <= np.pi + 1e-6
        # Simpson's rule needs the middle of a frame; the trapezoid is good to a few millimetres.
        moved = np.diff(states["fingertip_position"], axis=0)
        speed = states["fingertip_velocity"]
        np.testing.assert_allclose(moved, 0.05 * (speed[1:] + speed[:-1]), atol=0.02)
        assert not states["joint_velocity"][0].any()


def test_contacts_say_that_the_fingertip_was_above_the_marker(episodes):
    for episode in episodes["train"]:
        touched = {frame for frame, *_ in episode.contacts.tolist()}
        assert all(pair == [TIP_ID, GOAL_ID] for _, *pair in episode.contacts.tolist())
        inside = set(np.flatnonzero(misses(episode) < MARKER_RADIUS).tolist())
        assert inside <= touched
        near = set(np.flatnonzero(misses(episode) < MARKER_RADIUS + 0.2).tolist())
        assert touched <= near


@pytest.mark.parametrize(("split", "goal"), [("train", "central"), ("ood_test", "corner")])
def test_the_goal_is_reached_with_torques_within_the_split_s_range(episodes, split, goal):
    nearest = np.array([misses(episode).min() for episode in episodes[split]])
    assert (nearest < 0.03).mean() >= 0.95
    torques = np.concatenate([episode.actions[:-1] for episode in episodes[split]])
    low, high = np.array(LIMITS[goal], np.float32)
    assert torques.min() == low  # and both ends are met
    assert torques.max() == high


def test_the_policy_is_varied(episodes):
    for split in ("train", "ood_test"):
        some = episodes[split]
        tips = np.stack([episode.states["fingertip_position"] for episode in some])
        step = np.linalg.norm(np.diff(tips, axis=1), axis=2)
        assert 0.03 < step.mean() < 0.08
        assert step.max() < 0.3  # a tenth of the floor's width: nothing jumps
        assert 0.1 < (step < 0.01).mean() < 0.5  # and it holds or rests now and then
        angles = np.concatenate([episode.states["joint_angle"] for episode in some])
        for joint in (0, 1):
            spread = np.histogram(angles[:, joint], 8, (-np.pi, np.pi))[0] / len(angles)
            assert spread.min() > 0.02
        away = np.mean([(misses(episode) > 0.3).mean() for episode in some])
        assert 0.3 < away < 0.8  # it does other things than holding the goal
        assert len({episode.actions.tobytes() for episode in some}) == EPISODES


def test_goals_of_training_and_ood_lie_in_disjoint_sectors(episodes):
    for split, corner in (("train", False), ("ood_test", True)):
        for episode in episodes[split]:
            goal = episode.states["goal_position"][0]
            assert in_corner_sector(goal, 0.9) == corner
            assert episode.ood_label == ("goal=corner" if corner else None)
    rng, reach = np.random.default_rng(0), 0.9
    outside = np.array([Region(False).sample(reach, rng) for _ in range(500)])
    inside = np.array([Region(True).sample(reach, rng) for _ in range(500)])
    gaps = np.linalg.norm(outside[:, None] - inside[None], axis=2)
    assert gaps.min() > 0.03 * reach
    for points in (outside, inside):  # all four quarters alike
        quarter = np.histogram(np.arctan2(points[:, 1], points[:, 0]), 4, (-np.pi, np.pi))[0]
        assert quarter.min() > 80
    assert (np.linalg.norm(inside, axis=1) < reach).all()
    assert np.abs(inside).min() > 0.2  # towards the corners, away from both axes


def test_nothing_reaches_the_walls():
    longest = max(high for f in ReacherArm.card.factors if f.name == "forearm_length"
                  for _, high in f.ood)  # fmt: skip
    assert Links().lengths[0] + longest + 0.06 < INNER


@pytest.mark.parametrize(
    ("factor", "values"),
    [("forearm_length", (0.3, 0.48)), ("forearm_mass", (0.5, 3.0)), ("damping", (0.05, 1.5))],
)
def test_heavier_longer_and_stiffer_arms_move_less(unseen, factor, values):
    actions = np.zeros((49, 2), np.float32)
    actions[:3] = [1.5, 1.0]
    less, usual, more = (
        np.linalg.norm(run(unseen, actions, **setting).states["joint_velocity"][3])
        for setting in ({factor: values[0]}, {}, {factor: values[1]})
    )
    assert less > 1.03 * usual > 1.06 * more
