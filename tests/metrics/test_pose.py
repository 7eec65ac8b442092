"""Position and orientation errors against displacements and turns that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from acwm_core.env.physics import Physics, Reading
from acwm_core.env.rotations import FOLDS, rotations_of
from acwm_metrics.pose import (
    LARGEST,
    OrientationError,
    PixelPositionError,
    PositionError,
    angle_between,
    turn_between,
)
from tests.metrics.seeing import boxes, clip

FRAMES = 5
PLACES = np.random.default_rng(0).uniform(-1, 1, (FRAMES, 2, 3)).astype(np.float32)


def positions(read, true=None, **more):
    physics = Physics((Reading("place", "position", ("a", "b"), present=more.pop("present", "")),))
    states = {"place": PLACES, **more}
    return clip(physics, true=true, states=states, read={"place": read}, names="ab")


def test_a_copy_of_the_first_frame_is_off_by_the_true_displacement():
    still = np.repeat(PLACES[:1], FRAMES, 0)
    moved = np.linalg.norm(PLACES - PLACES[0], axis=-1).mean(1)
    assert PositionError().per_frame(positions(still)) == pytest.approx(moved, rel=1e-6)


def test_pixels_are_those_of_the_estimators_camera():
    shifted = PLACES + np.array([0.03, 0.04, 9.0], np.float32)  # depth along the line of sight
    assert PixelPositionError().value(positions(shifted)) == pytest.approx(5.0, rel=1e-4)


def test_bodies_that_do_not_exist_or_are_not_seen_do_not_count():
    read = PLACES.copy()
    read[:, 1] = 7
    present = np.tile(np.float32([1, 0]), (FRAMES, 1))
    assert PositionError().value(positions(read, there=present, present="there")) == 0
    read[2] = np.nan
    errors = PositionError().per_frame(positions(read, there=present, present="there"))
    assert np.isnan(errors[2])
    assert np.nansum(errors) == 0


def test_what_the_truth_shows_counts_where_it_was_last_seen():
    true = boxes(FRAMES, (2, 2), (20, 20))
    read = PLACES.copy()
    read[0], read[2:4] = np.nan, np.nan
    seen = PLACES[[0, 1, 1, 1, 4]]  # before anything is seen, the given frame tells
    error = PositionError().per_frame(positions(read, true))
    assert error == pytest.approx(np.linalg.norm(seen - PLACES, axis=-1).mean(1), rel=1e-6)
    assert PositionError().coverage(positions(read, true), error) == pytest.approx(2 / 5)
    hidden = np.where(np.arange(FRAMES)[:, None, None] < 4, true, true[:1] * 0)
    read[:4], read[4] = PLACES[:4], np.nan
    assert np.isnan(PositionError().per_frame(positions(read, hidden))[4])


def test_a_curve_may_be_read_from_either_end():
    rope = np.random.default_rng(1).normal(size=(FRAMES, 9, 2))
    physics = Physics((Reading("rope", "curve", ("rope",)),))
    for read, error in ((rope[:, ::-1], 0.0), (rope + np.array([0.3, 0.4]), 0.5)):
        seen = clip(physics, states={"rope": rope}, read={"rope": read}, names=["rope"])
        assert PositionError().value(seen) == pytest.approx(error, abs=1e-9)


@pytest.mark.parametrize(
    ("symmetry", "turned", "error"),
    [
        ("none", 2 * np.pi + 0.2, 0.2),
        ("quarter_turn", np.pi / 2 - 0.2, 0.2),
        ("quarter_turn", np.pi / 4, np.pi / 4),
        ("half_turn", -np.pi + 0.1, 0.1),
    ],
)
def test_angles_count_up_to_what_looks_the_same(symmetry, turned, error):
    physics = Physics((Reading("yaw", "angle", ("a",), symmetry),))
    yaw = np.linspace(-3, 3, FRAMES)
    seen = clip(physics, states={"yaw": yaw}, read={"yaw": yaw + turned}, names="a")
    assert OrientationError().value(seen) == pytest.approx(error)
    gone, there = np.full(FRAMES, np.nan), boxes(FRAMES, (2, 2))
    seen = clip(physics, true=there, states={"yaw": yaw}, read={"yaw": gone}, names="a")
    assert OrientationError().value(seen) == pytest.approx(np.pi / FOLDS[symmetry])
    assert OrientationError().coverage(seen, gone) == 0


@pytest.mark.parametrize(("symmetry", "order"), [("none", 1), ("box", 4), ("cube", 24)])
def test_rotations_of_a_body_form_its_group(symmetry, order):
    group = rotations_of(symmetry)
    assert len(group) == order
    products = Rotation.from_quat(np.roll(group, -1, 1)[:, None].repeat(order, 1).reshape(-1, 4))
    products *= Rotation.from_quat(np.roll(np.tile(group, (order, 1)), -1, 1))
    found = np.roll(products.as_quat(), 1, axis=1)
    assert turn_between(found, group[:1], symmetry) == pytest.approx(0, abs=1e-6)


def test_turns_agree_with_scipy():
    rng = np.random.default_rng(2)
    a, b = (Rotation.random(2000, rng) for _ in range(2))
    found = turn_between(*(np.roll(each.as_quat(), 1, axis=1) for each in (a, b)), "none")
    assert found == pytest.approx((a * b.inv()).magnitude(), abs=1e-6)
    for symmetry, group in (("cube", "O"), ("box", "D2"), ("none", "C1")):
        turns = Rotation.create_group(group)  # 24, 4 and 1 rotations
        least = np.min([(a * turn * b.inv()).magnitude() for turn in turns], axis=0)
        found = turn_between(*(np.roll(each.as_quat(), 1, axis=1) for each in (a, b)), symmetry)
        assert found == pytest.approx(least, abs=1e-6)
        assert 0.8 * LARGEST[symmetry] < found.max() <= LARGEST[symmetry]


def test_angles_are_never_more_than_half_a_period():
    angles = np.random.default_rng(3).uniform(-20, 20, 1000)
    assert angle_between(angles, 0 * angles, "quarter_turn").max() <= np.pi / 4


def test_why_nothing_can_be_measured():
    card = positions(PLACES).card
    assert "no estimator" in PositionError().unavailable(card, None)
    blind = positions(PLACES).estimator
    assert "no angle" in OrientationError().unavailable(card, blind)
    assert PositionError().unavailable(card, blind) is None
