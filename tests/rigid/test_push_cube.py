"""push_cube as a user meets it: actions, ground truth, policy, splits, reproducibility."""

import numpy as np
import pytest

from acwm_core.env.episode import EpisodeSpec
from acwm_rigid.push_cube import REACH, PushCube, PushCubeCrowded, PushCubeTwoPushers
from acwm_rigid.push_drawing import PALETTES
from tests.sim.playing import play, states, undrawn


@pytest.fixture(scope="module")
def env():
    return PushCube(size=64)


@pytest.fixture(scope="module")
def unseen():
    return undrawn(PushCube)(size=64)


def test_action_moves_the_pusher_to_that_place_in_metres(env):
    _, info = env.reset(options={"spec": EpisodeSpec("push_cube", factors={"cube_count": 1})})
    start = info["state"]["pusher_position"][0]
    home = start / REACH
    for axis in (0, 1):
        goal = home.copy()
        goal[axis] += 0.1 * (1 if home[axis] < 0 else -1)
        info = env.step(goal.astype(np.float32))[4]
        moved = info["state"]["pusher_position"][0] - start
        expected = (goal - home) * REACH
        np.testing.assert_allclose(moved, expected, atol=3e-3)
        env.step(home.astype(np.float32))


def test_positive_x_is_right_and_positive_y_is_up_in_the_frame(env):
    _, infos, _ = play(env, index=3, frames=12)
    for info in infos:
        rows, columns = np.nonzero(info["mask"] == 2)
        x, y = info["state"]["pusher_position"][0]
        per_metre = env.drawing.scene.camera.focal(64) / (1.25 - 0.09)  # at the top of the pusher
        assert columns.mean() + 0.5 - 32 == pytest.approx(x * per_metre, abs=1.0)
        assert 32 - rows.mean() - 0.5 == pytest.approx(y * per_metre, abs=1.0)


def test_masks_states_and_colours_name_the_same_cubes(env):
    seen, infos, _ = play(env, "ood_test", 1, frames=2)
    present = np.flatnonzero(infos[0]["state"]["cube_present"])
    ids = set(np.unique(infos[0]["mask"])) - {0, 1, 2}
    assert ids == {3 + slot for slot in present}
    for slot in present:
        shown = seen[0][infos[0]["mask"] == 3 + slot].astype(float).mean(0)
        paint = np.array(PALETTES["bright"][slot])
        assert np.corrcoef(shown, paint)[0, 1] > 0.9
    assert env.card.instances[3] == "cube_1"


def test_contacts_agree_with_the_distances(unseen):
    _, infos, _ = play(unseen, index=5)
    places, present = states(infos, "cube_position"), infos[0]["state"]["cube_present"] > 0
    pushers = states(infos, "pusher_position")[:, 0]
    assert any(len(info["contacts"]) for info in infos)
    for t, info in enumerate(infos):
        touching = {b - 3 for a, b in info["contacts"] if a == 2}
        assert touching <= set(np.flatnonzero(present))
        for slot in np.flatnonzero(present):
            gap = np.linalg.norm(places[t, slot, :2] - pushers[t])
            if slot in touching:  # at some time in a frame of at most 6.5 cm of motion
                assert gap < 0.0566 + 0.03 + 0.07
            else:
                assert gap > 0.04 + 0.03 - 2e-3


@pytest.mark.ci
def test_policy_touches_cubes_in_most_episodes_and_keeps_moving(unseen):
    touched, steps, moved, headings = 0, [], [], []
    for index in range(20):
        _, infos, actions = play(unseen, index=index)
        assert np.abs(actions).max() <= 1
        touched += any(a == 2 for info in infos for a, _ in info["contacts"])
        path = states(infos, "pusher_position")[:, 0]
        steps.append(np.linalg.norm(np.diff(path, axis=0), axis=1))
        cubes = states(infos, "cube_position")[:, :, :2]
        moved.append(np.linalg.norm(np.diff(cubes, axis=0), axis=2).sum(0).max())
        change = np.diff(path, axis=0)
        headings.append(np.arctan2(change[:, 1], change[:, 0]))
    step = np.concatenate(steps)
    assert touched / 20 >= 0.85
    assert 0.02 < step.mean() < 0.04
    assert step.max() < 0.08  # it never jumps
    assert 0.02 < (step < 0.005).mean() < 0.3  # and pauses now and then
    assert np.mean(np.array(moved) > 0.1) > 0.8
    spread = np.histogram(np.concatenate(headings), 8, (-np.pi, np.pi))[0]
    assert spread.min() > 0.5 * spread.mean()


def test_train_starts_in_the_middle_with_one_to_three_cubes(unseen):
    counts = set()
    for index in range(20):
        _, infos, _ = play(unseen, ("train", "ind_test")[index % 2], index, frames=1)
        state, present = infos[0]["state"], infos[0]["state"]["cube_present"] > 0
        assert np.abs(state["cube_position"][present, :2]).max() <= 0.15
        assert infos[0]["ood_label"] is None
        counts.add(int(present.sum()))
    assert counts == {1, 2, 3}


def test_ood_shifts_placement_and_count_in_turn(unseen):
    labels, ends = [], []
    for index in range(12):
        _, infos, _ = play(unseen, "ood_test", index)
        labels.append(infos[0]["ood_label"])
        place, present = states(infos, "cube_position"), infos[0]["state"]["cube_present"] > 0
        rim = np.abs(place[:, present, :2]).max(-1)
        if labels[-1] == "placement=edge":
            assert rim[0].min() > 0.18
            assert present.sum() <= 3
            ends.append(rim[-1].mean())
        else:
            assert rim[0].max() <= 0.15
            assert present.sum() in (4, 5)
    assert labels[::2] == ["placement=edge"] * 6
    assert {*labels[1::2]} == {"cube_count=4", "cube_count=5"}
    assert np.mean(ends) > 0.18  # they are pushed along the edges, not to the middle


def test_variants():
    crowded = PushCubeCrowded(size=64)
    _, info = crowded.reset(options={"spec": EpisodeSpec("push_cube_4cube", "ood_test", 0)})
    assert info["state"]["cube_present"].sum() >= 4
    pair = PushCubeTwoPushers(size=64)
    _, infos, actions = play(pair, index=0, frames=20)
    assert actions.shape == (19, 4)
    assert {2, 3} <= set(np.unique(infos[0]["mask"]))
    step = np.linalg.norm(np.diff(states(infos, "pusher_position"), axis=0), axis=-1)
    assert (step.mean(0) > 0.01).all()
    assert pair.card.instances[4] == "cube_1"
