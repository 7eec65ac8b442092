"""push_rope as a user meets it: actions, ground truth, policy, splits, reproducibility, looks."""

import numpy as np
import pytest

from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.push_rope import MAX_STEP, PushRope
from acwm_deformable.rope import POLE_ROOM
from acwm_deformable.rope_drawing import CAMERAS, POLE_ID, ROPE_ID
from tests.sim.playing import play, start, states, undrawn

STILL = np.zeros(2, np.float32)


@pytest.fixture(scope="module")
def env():
    return PushRope(size=64)


@pytest.fixture(scope="module")
def unseen():
    return undrawn(PushRope)(size=64)


@pytest.fixture(scope="module")
def episodes(unseen):
    """Sixteen whole training episodes: infos and actions."""
    return [play(unseen, ("train", "ind_test")[k % 2], k)[1:] for k in range(16)]


def touches(infos):
    return np.array([(ROPE_ID, POLE_ID) in info["contacts"] for info in infos])


def test_an_action_moves_the_pole_by_that_much(unseen):
    for index in range(4):
        start(unseen, index=index)
        place = unseen.simulation.pole.astype(float)
        for action in ((0.02, 0.0), (0.0, 0.03), (-0.05, 0.01), (0.0, 0.0)):
            state = unseen.step(np.array(action, np.float32))[4]["state"]
            place = np.clip(place + action, np.negative(POLE_ROOM), POLE_ROOM)
            np.testing.assert_allclose(state["pole_position"], place, atol=1e-5)
        np.testing.assert_array_equal(state["pole_velocity"], 0)


def test_delta_x_leads_right_and_delta_z_away_in_the_frame(env):
    start(env, index=3)

    def middle():
        rows, columns = np.nonzero(env._render()[1] == POLE_ID)
        return columns.mean(), rows.mean()

    env.simulation.pole[:] = (-0.3, -0.3)
    left, low = middle()
    for _ in range(10):
        env.step(np.array([0.06, 0.0], np.float32))
    right, low_still = middle()
    for _ in range(10):
        env.step(np.array([0.0, 0.06], np.float32))
    assert right > left + 8
    assert low_still == pytest.approx(low, abs=1.0)
    assert middle()[1] < low - 8


def test_the_rope_keeps_its_length_and_its_distance_from_the_pole(episodes):
    for infos, _ in episodes:
        length = infos[0]["factors"]["length"]
        np.testing.assert_allclose(states(infos, "rope_length")[:, 0], length, rtol=0.01)
        nodes, pole = states(infos, "rope_position"), states(infos, "pole_position")
        np.testing.assert_allclose(
            np.linalg.norm(np.diff(nodes, axis=1), axis=2), length / 79, rtol=0.02
        )
        gaps = np.linalg.norm(nodes - pole[:, None], axis=2) - POLE_RADIUS - 0.035
        assert gaps.min() > -0.0035


def test_contacts_agree_with_the_distances(episodes):
    for infos, _ in episodes:
        nodes, pole = states(infos, "rope_position"), states(infos, "pole_position")
        gaps = np.linalg.norm(nodes - pole[:, None], axis=2).min(1) - POLE_RADIUS - 0.035
        met = touches(infos)
        assert not met[0]
        assert gaps[met].max() < 0.09  # at some time in a frame of at most 8.5 cm of motion
        assert gaps[~met].min() > -1e-4


def test_velocities_are_those_of_the_positions(episodes):
    for infos, _ in episodes[:5]:
        pole = states(infos, "pole_position")
        np.testing.assert_allclose(
            states(infos, "pole_velocity")[1:], np.diff(pole, axis=0) * 10, atol=1e-5
        )
        moved = np.diff(states(infos, "rope_position"), axis=0) * 10
        speed = states(infos, "rope_velocity")
        still = (np.abs(moved) < 1e-4).all((1, 2))
        assert np.abs(speed[1:][still]).max(initial=0) < 1e-2
        fast = np.linalg.norm(moved, axis=2) > 0.3
        cosine = (moved * speed[1:]).sum(2)[fast] > 0
        assert cosine.mean() > 0.8


def test_the_policy_pushes_much_pauses_now_and_then_and_never_jumps(episodes):
    met = np.array([touches(infos) for infos, _ in episodes])
    steps = np.linalg.norm([actions for _, actions in episodes], axis=2)
    headings = np.concatenate([np.arctan2(a[:, 1], a[:, 0]) for _, a in episodes])
    ends = [states(infos, "rope_position")[[0, -1]] for infos, _ in episodes]
    moved = np.array([np.linalg.norm(last - first, axis=1).max() for first, last in ends])
    assert met.any(1).mean() > 0.9
    assert 0.3 < met.mean() < 0.8
    assert np.abs([actions for _, actions in episodes]).max() <= MAX_STEP
    assert 0.035 < steps.mean() < 0.055
    assert 0.01 < (steps < 0.003).mean() < 0.2
    assert (moved > 0.2).mean() > 0.85
    spread = np.histogram(headings, 8, (-np.pi, np.pi))[0]
    assert spread.min() > 0.4 * spread.mean()


def test_the_policy_pushes_middle_and_ends_of_the_rope_from_both_sides(episodes):
    where, sides = [], []
    for infos, _ in episodes:
        nodes, pole = states(infos, "rope_position"), states(infos, "pole_position")
        for t in np.flatnonzero(touches(infos)):
            nearest = np.linalg.norm(nodes[t] - pole[t], axis=1).argmin()
            where.append(nearest / 79)
            a, b = nodes[t, max(nearest - 1, 0)], nodes[t, min(nearest + 1, 79)]
            run, away = b - a, pole[t] - a
            sides.append(run[0] * away[1] > run[1] * away[0])
    shares = np.histogram(where, 4, (0, 1))[0] / len(where)
    assert shares.min() > 0.1
    assert 0.3 < np.mean(sides) < 0.7


def test_rope_and_pole_stay_in_view(episodes):
    outside = []
    for infos, _ in episodes:
        nodes, pole = states(infos, "rope_position"), states(infos, "pole_position")
        points = np.concatenate([nodes, pole[:, None]], axis=1)
        raised = np.concatenate([points, np.full((*points.shape[:2], 1), 0.035)], axis=2)
        seen = CAMERAS["front"].project(raised, 240, 240)[..., :2]
        outside.append(np.maximum(-seen, seen - 240).max())
        assert (np.abs(pole) <= np.array(POLE_ROOM) + 1e-6).all()
    assert np.mean(np.array(outside) > 0) <= 0.07
    assert max(outside) < 12


def test_ood_ropes_are_longer_than_any_in_training(unseen, episodes):
    lengths = [infos[0]["factors"]["length"] for infos, _ in episodes]
    assert 2.0 <= min(lengths) < 2.2
    assert 2.6 < max(lengths) <= 2.8
    assert {infos[0]["ood_label"] for infos, _ in episodes} == {None}
    for index in range(3):
        _, infos, _ = play(unseen, "ood_test", index, frames=30)
        assert infos[0]["ood_label"] == "length"
        np.testing.assert_allclose(states(infos, "rope_length"), 3.1, rtol=0.01)


def test_starts_differ_from_episode_to_episode(episodes):
    first = np.array([infos[0]["state"]["rope_position"] for infos, _ in episodes])
    pairs = np.abs(first[:, None] - first[None]).max((2, 3))[np.triu_indices(len(first), 1)]
    assert pairs.min() > 0.1
    assert np.ptp(first.mean(1), axis=0).min() > 0.6  # they lie all over the table
