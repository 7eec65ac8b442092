"""cloth_move as a user meets it: actions, ground truth, splits, factors, reproducibility."""

import numpy as np
import pytest

from acwm_deformable.cloth import THICKNESS
from acwm_deformable.cloth_drawing import PATTERNS, normals_of
from acwm_deformable.cloth_move import ClothMove
from acwm_deformable.physics import HAND_RADIUS
from tests.deformable.cloth_play import CLOTH, HANDS, SPHERE, Unseen, Unseen8D, begin
from tests.sim.playing import play, start


@pytest.fixture(scope="module")
def env():
    return ClothMove(size=64)


@pytest.fixture(scope="module")
def arms():
    return Unseen8D(size=64)


@pytest.fixture(scope="module")
def unseen():
    return Unseen(size=64)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_action_moves_both_grippers_that_far_in_metres(unseen, axis):
    before = begin(unseen, index=2)["gripper_position"]
    action = np.zeros(3, np.float32)
    action[axis] = 0.02 if axis == 1 else -0.02
    for _ in range(2):
        state = unseen.step(action)[4]["state"]
    np.testing.assert_allclose(
        state["gripper_position"] - before, np.tile(2 * action, (2, 1)), atol=2e-4
    )


def test_positive_x_is_right_and_positive_z_is_up_in_the_frame(env):
    begin(env, index=2)
    place = [np.argwhere(env.step(np.zeros(3, np.float32))[4]["mask"] == 3).mean(0)]
    for action in ((0.05, 0, 0), (0, 0, -0.05)):
        for _ in range(2):
            mask = env.step(np.array(action, np.float32))[4]["mask"]
        place.append(np.argwhere(mask == 3).mean(0))
    assert place[1][1] > place[0][1] + 1
    assert place[2][0] > place[1][0] + 1


def test_zero_holds_still(unseen):
    before = begin(unseen, index=1)
    for _ in range(5):
        state = unseen.step(np.zeros(3, np.float32))[4]["state"]
    np.testing.assert_array_equal(state["gripper_position"], before["gripper_position"])
    moved = np.linalg.norm(
        state["cloth_position"] - before["cloth_position"].astype(float), axis=-1
    )
    assert moved.mean() < 0.04


def test_grasp_commands(arms):
    begin(arms, index=0)
    zero, corner = np.zeros(8, np.float32), (0, 0)
    state = arms.step(zero)[4]["state"]
    assert state["gripper_holds"].tolist() == [1, 1]  # zero keeps things as they are
    start = state["cloth_position"][corner].astype(float)
    let_go = zero.copy()
    let_go[3] = -1.0
    for action in (let_go, zero, zero, zero):  # open, and stay open
        _, _, _, _, info = arms.step(action)
    state = info["state"]
    assert state["gripper_holds"].tolist() == [0, 1]
    assert state["cloth_position"][corner][2] < start[2] - 0.15
    np.testing.assert_allclose(
        state["cloth_position"][0, -1], state["gripper_position"][1], atol=1e-3
    )
    assert (CLOTH, HANDS[1]) in info["contacts"]
    assert (CLOTH, HANDS[0]) not in info["contacts"]
    grab = zero.copy()
    grab[3] = 1.0
    assert arms.step(grab)[4]["state"]["gripper_holds"].tolist() == [0, 1]  # nothing in reach


def test_arms_move_on_their_own(arms):
    before = begin(arms, index=1)["gripper_position"]
    action = np.array([0, 0, 0.02, 0, 0, 0, 0, 0], np.float32)
    after = arms.step(action)[4]["state"]["gripper_position"]
    np.testing.assert_allclose(after - before, [[0, 0, 0.02], [0, 0, 0]], atol=1e-5)


def test_state_contacts_and_mask_agree(env):
    _, infos, _ = play(env, index=1)
    touched = 0
    for info in infos:
        state, contacts = info["state"], info["contacts"]
        gap = np.linalg.norm(state["cloth_position"] - state["sphere_position"], axis=-1)
        if (SPHERE, CLOTH) in contacts:
            touched += 1
            assert gap.min() < 0.2 + 0.08  # a node between, or a frame's motion away
        else:
            assert gap.min() > 0.2 + THICKNESS - 2e-3
        hands = np.linalg.norm(state["gripper_position"] - state["sphere_position"], axis=1)
        assert hands.min() > 0.2 + HAND_RADIUS - 2e-3
        corners = state["cloth_position"][0, [0, -1]].astype(float)
        np.testing.assert_allclose(corners, state["gripper_position"], atol=1e-3)
        assert {(CLOTH, hand) for hand in HANDS} <= set(contacts)
        assert {CLOTH, *HANDS} <= set(np.unique(info["mask"]))
    assert 0 < touched < 64
    assert infos[0]["state"]["cloth_position"].dtype == np.float16


def test_ood_shifts_size_and_placement_in_turn(unseen):
    labels = []
    for index in range(12):
        _, info = start(unseen, "ood_test", index)
        labels.append(info["ood_label"])
        middle = info["state"]["gripper_position"].mean(axis=0)
        size = float(info["state"]["cloth_size"])
        if labels[-1] == "cloth_size":
            assert size < 0.53 or size > 0.85
            assert abs(middle[0]) > 0.2
        else:
            assert 0.6 <= size <= 0.75
            assert abs(middle[1]) > 0.25
    assert labels[::2] == ["cloth_size"] * 6
    assert set(labels[1::2]) == {"placement=front", "placement=behind"}


def test_stiff_cloth_folds_less(unseen):
    """Mean angle between neighbouring normals of a cloth that lies crumpled on the sphere."""
    bends = []
    for stiffness in (2e-6, 1e-3):
        begin(unseen, index=2, stiffness=stiffness)
        for step in [(0.04, 0.0, 0.0)] * 10 + [(0.0, 0.0, -0.04)] * 8 + [(0.0, 0.0, 0.0)] * 6:
            unseen.step(np.array(step, np.float32))
        normals = normals_of(unseen.simulation.nodes).reshape(41, 41, 3)
        cosine = (normals[1:] * normals[:-1]).sum(-1).clip(-1, 1)
        bends.append(float(np.arccos(cosine).mean()))
    assert bends[1] < 0.8 * bends[0]


def test_slippery_cloth_slides_off_the_sphere_sooner(unseen):
    """Cloth laid over the sphere and pulled on: more of it stays behind when it grips."""
    behind = []
    for friction in (0.0, 1.0):
        begin(unseen, index=2, friction=friction)
        for step in [(0.05, 0.03, 0.0)] * 11 + [(0.03, 0.02, -0.02)] * 8:
            unseen.step(np.array(step, np.float32))
        behind.append(float(unseen.simulation.nodes[:, :2].mean(axis=0) @ (0.83, 0.55)))
    assert behind[1] < behind[0] - 0.01


def test_both_sides_of_the_cloth_have_their_colour(env):
    seen, infos, _ = play(env, index=2, pattern="plain", frames=24)
    shade = [
        frame[info["mask"] == CLOTH].astype(float).mean(0)
        for frame, info in zip(seen, infos, strict=True)
    ]
    for color in shade:
        assert np.corrcoef(color, PATTERNS["plain"][0])[0, 1] > 0.8
    assert max(c[1] for c in shade) > 1.2 * min(c[1] for c in shade)  # the back is darker
