"""Violations that are put into what is seen are found, and lawful motion is none."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.env.physics import Constant, Gap, Physics, Reading
from acwm_metrics.calibrate import calibrate, worst
from acwm_metrics.conservation import (
    AmountError,
    LengthError,
    Penetration,
    Permanence,
    Violations,
    lasting,
    violations,
)
from tests.metrics.seeing import SIDE, boxes, clip

NAMES = ("a", "b", "c")
SOLID = Physics(objects=NAMES)
FRAMES = 10
TRUE = boxes(FRAMES, (3, 3), (20, 20))  # there is no c


def broken(change, start=5):
    """Masks in which `change` is done to the frames from `start` on."""
    masks = TRUE.copy()
    change(masks[start:])
    return masks


def vanish(masks):
    masks[masks == 2] = 0


def double(masks):
    masks[:, 20:26, 5:11] = 1


def appear(masks):
    masks[:, 3:9, 20:26] = 3


@pytest.mark.parametrize("change", [vanish, double, appear])
def test_objects_that_vanish_double_or_appear_are_found(change):
    seen = clip(SOLID, seen=broken(change), true=TRUE, names=NAMES)
    assert Permanence().per_frame(seen).tolist() == [1] * 5 + [0] * 5
    assert Violations().value(seen) == 1
    assert list(np.flatnonzero(Violations().per_frame(seen))) == [5, 6, 7, 8, 9]


def test_an_object_that_splits_is_found():
    def part(masks):
        masks[:, 20:26, 22:26] = 0
        masks[:, 20:26, 28:30] = 2

    assert Permanence().value(clip(SOLID, seen=broken(part), true=TRUE, names=NAMES)) == 0.5


def test_all_that_moves_and_meets_is_lawful():
    masks = np.concatenate([boxes(1, (3, 3 + k), (20, 20 - k)) for k in range(FRAMES)])
    assert Permanence().value(clip(SOLID, seen=masks, true=TRUE, names=NAMES)) == 1
    assert Violations().value(clip(SOLID, seen=masks, true=TRUE, names=NAMES)) == 0


def test_an_object_may_be_hidden_behind_another():
    def cover(masks):
        masks[:] = boxes(len(masks), (20, 20), None)  # a stands where b was

    assert Permanence().value(clip(SOLID, seen=broken(cover), names=NAMES)) == 1
    late = clip(SOLID, seen=broken(cover, 7), true=broken(cover), names=NAMES)
    assert Permanence().value(late) == 1


def test_nothing_is_hidden_but_by_what_is_there_in_truth():
    def black(masks):  # estimators take what they never saw for something
        masks[:] = 1

    assert Permanence().value(clip(SOLID, seen=broken(black), true=TRUE, names=NAMES)) == 0.5


def test_what_hardly_differs_from_its_surroundings_is_not_there():
    video = torch.zeros(FRAMES, 3, SIDE, SIDE)
    for instance, colour in ((1, 0.5), (2, 1.0)):
        video[:] += colour * torch.from_numpy(instance == TRUE)[:, None]
    for light, found in ((0.3, 1.0), (0.2, 0.5)):
        faint = torch.where(torch.arange(FRAMES)[:, None, None, None] < 5, video, light * video)
        seen = replace(clip(SOLID, true=TRUE, names=NAMES), video=faint, target=video)
        assert Permanence().value(seen) == found


def test_it_may_be_carried_behind_what_all_but_hid_it():
    """A hand (a) closes over an object (b) until two rows of it are left, and moves off with it."""
    steps = [boxes(1, (row, 20), (20, 20))[0] for row in (3, 12, 15)]
    hand = [boxes(1, (20 - k, 20 - k))[0] for k in range(2, 9)]
    steps[2][18:24, 20:26] = 1
    held = clip(SOLID, seen=np.stack([*steps, *hand]), names=NAMES)
    assert Violations().value(held) == 1  # what has no position stays where it is
    loose = Physics(objects=NAMES, readings=(Reading("place", "position", NAMES),))
    held = clip(loose, seen=np.stack([*steps, *hand]), names=NAMES)
    assert Violations().value(held) == 0
    never = clip(loose, seen=np.stack([*steps, *hand]), true=TRUE, names=NAMES)
    assert Violations().value(never) == 1  # the true hand did not take it
    gone = clip(loose, seen=np.stack([*steps[:2], *hand]), true=TRUE[:9], names=NAMES)
    assert Violations().value(gone) == 1  # it vanished in full sight


def test_it_may_be_cut_in_two_by_what_is_before_it():
    def cross(masks):
        masks[masks == 1] = 0
        masks[:, 15:31, 22:24] = 1  # a stands upright before the middle of b

    assert Permanence().value(clip(SOLID, seen=broken(cross), true=TRUE, names=NAMES)) == 1


def test_it_may_reach_beyond_the_frame():
    bow = np.zeros((4, SIDE, SIDE), np.uint8)
    bow[:, :10, 3:6] = bow[:, :10, 20:23] = 1
    assert Permanence().value(clip(Physics(objects=("a",)), seen=bow, names=("a",))) == 1


def test_a_slip_of_one_frame_is_no_violation():
    seen = clip(SOLID, seen=broken(vanish, FRAMES - 2), true=TRUE, names=NAMES)
    assert Permanence().value(seen) == 0.8
    assert Violations().value(seen) == 0


def test_runs_that_last():
    flags = np.array([1, 1, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1, 0], bool)
    assert lasting(flags).astype(int).tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1, 0]
    assert not lasting(np.ones(2, bool)).any()


def test_objects_must_be_missing_as_long_as_the_estimator_can_miss_them():
    slow = Physics(objects=NAMES, lasting=5)
    for start, found in ((FRAMES - 4, 0), (FRAMES - 5, 1)):
        seen = clip(slow, seen=broken(vanish, start), true=TRUE, names=NAMES)
        assert Violations().value(seen) == found


def test_the_longest_slip_sets_how_long_objects_must_be_missing():
    slips = [clip(SOLID, seen=broken(vanish, start), true=TRUE, names=NAMES) for start in (9, 4)]
    limits = calibrate(slips)
    assert limits["objects.lasting"] == 11  # longer than 1.7 times the six frames of the longer one
    assert calibrate(slips[:1])["objects.lasting"] == 3


def test_what_is_hidden_for_longer_than_anything_is_was_taken_away():
    def cover(masks):
        masks[masks == 2] = 3

    physics = Physics(objects=NAMES[:2], shapes=NAMES[2:])
    for unseen, found in ((math.inf, 0), (8, 0), (7, 1)):
        limited = replace(physics, unseen=unseen)
        seen = clip(limited, seen=broken(cover, start=3), names=NAMES)
        assert Permanence().value(seen) == 1
        assert Violations().value(seen) == found
    assert calibrate([seen])["objects.unseen"] == 9  # a fifth longer than these seven frames


def level(seen, start):
    return np.asarray(seen.states["level"], np.float64)


def reach(seen, start):
    return np.asarray(seen.states["reach"], np.float64) - start["wall"]


AMOUNT = Physics(constants=(Constant("water", "amount", level, 0.1),))


def test_a_fifth_of_the_water_missing_is_found():
    true = np.full(FRAMES, 50.0)
    read = np.where(np.arange(FRAMES) < 4, 50.0, 40.0)
    seen = clip(AMOUNT, states={"level": true}, read={"level": read})
    assert AmountError().per_frame(seen) == pytest.approx([0] * 4 + [0.2] * 6)
    assert violations(seen)["water"].tolist() == [False] * 4 + [True] * 6
    assert "no length" in LengthError().unavailable(seen.card, seen.estimator)


def test_more_of_it_is_as_wrong_as_less():
    seen = clip(AMOUNT, states={"level": np.full(4, 5.0)}, read={"level": np.full(4, 6.0)})
    assert AmountError().value(seen) == pytest.approx(0.2)


def test_a_change_must_last_as_long_as_the_estimator_can_be_wrong():
    slow = Physics(constants=(Constant("water", "amount", level, 0.1, lasting=5),))
    for missing, found in ((4, 0), (5, 1)):
        read = np.where(np.arange(FRAMES) < missing, 40.0, 50.0)
        seen = clip(slow, states={"level": np.full(FRAMES, 50.0)}, read={"level": read})
        assert Violations().value(seen) == found


def test_the_depth_of_the_deepest_overlap():
    gaps = (
        Gap("wall", ("ground", "a"), reach, solid=0.02),
        Gap("marker", ("ground", "b"), lambda seen, start: reach(seen, start) - 9),  # not solid
    )
    states = {"wall": np.full(FRAMES, 1.0), "reach": np.full(FRAMES, 1.5)}
    read = {"reach": np.where(np.arange(FRAMES) < 6, 1.5, 0.9)}
    seen = clip(Physics(gaps=gaps), states=states, read=read)
    near = [math.nan] * 6 + [0.1] * 4  # where they do not meet there is nothing to measure
    assert Penetration().per_frame(seen) == pytest.approx(near, nan_ok=True)
    assert violations(seen)["ground in a"].sum() == 4
    lost = clip(Physics(gaps=gaps), states=states, read={"reach": np.full(FRAMES, np.nan)})
    assert np.isnan(Penetration().value(lost))
    assert Violations().value(lost) == 0


def test_bodies_run_into_one_that_vanished():
    """b vanishes at 0.5 m; a moves on through this place, from 0 to 0.9 m."""
    places = np.stack([np.linspace(0, 0.9, FRAMES), np.full(FRAMES, 0.5)], 1)[..., None]
    gap = Gap("pair", ("a", "b"), lambda seen, start: 0.2 - overlap(seen.states["place"]), solid=0)
    physics = Physics((Reading("place", "position", ("a", "b")),), gaps=(gap,))
    read = np.where(np.arange(FRAMES)[:, None, None] < 3, places, [[np.nan], [np.nan]])
    read[:, 0] = places[:, 0]
    for states in (places, read):
        seen = clip(
            physics, true=TRUE, states={"place": places}, read={"place": states}, names="ab"
        )
        assert np.nanmax(Penetration().per_frame(seen)) == pytest.approx(0.2)


def test_bodies_that_both_vanish_are_run_into_by_each_others_true_motion():
    """a pushes b from 0.3 m on; a prediction in which both vanish before is no better."""
    pushing = np.linspace(0, 0.9, FRAMES)
    places = np.stack([pushing, np.maximum(0.5, pushing + 0.2)], 1)[..., None]
    gap = Gap(
        "pair", ("a", "b"), lambda seen, start: 0.2 - overlap(seen.states["place"]), solid=0.05
    )
    physics = Physics((Reading("place", "position", ("a", "b")),), gaps=(gap,))

    def depth(first, then=None):
        read = places.copy()
        read[first:then] = np.nan
        return Penetration().value(
            clip(physics, true=TRUE, states={"place": places}, read={"place": read}, names="ab")
        )

    assert depth(FRAMES) == pytest.approx(0, abs=1e-9)
    # b stays at 0.5 m, and a moves on through this place in steps of 0.1 m
    assert depth(2) == pytest.approx(np.mean([0.1, 0.2, 0.1]))  # touching alone counts for nothing
    assert depth(2, 3) == pytest.approx(0, abs=1e-9)  # both are found again when they meet


STOPS = np.minimum(np.linspace(0, 0.9, FRAMES), 0.3)
"""The true motion of a, which stops at b, a wall at 0.5 m."""


@pytest.mark.parametrize("bodies", [[0, 1], [0], [1]], ids=["both", "a", "b"])
@pytest.mark.parametrize("hidden", ["early", "from the start", "where they overlap", "in turn"])
def test_vanishing_is_never_scored_as_no_overlap(hidden, bodies):
    """A prediction in which a runs through b; what it hides makes it no better than it is."""
    places = np.stack([STOPS, np.full(FRAMES, 0.5)], 1)[..., None]
    gap = Gap(
        "pair", ("a", "b"), lambda seen, start: 0.2 - overlap(seen.states["place"]), solid=0.05
    )
    physics = Physics((Reading("place", "position", ("a", "b")),), gaps=(gap,))
    read = places.copy()
    read[:, 0, 0] = np.linspace(0, 0.9, FRAMES)

    def value(read):
        return Penetration().value(
            clip(physics, true=TRUE, states={"place": places}, read={"place": read}, names="ab")
        )

    visible = value(read)
    assert visible > 0.05
    frames = {
        "early": slice(2, None),
        "from the start": slice(1, None),
        "where they overlap": slice(4, 9),
        "in turn": slice(5, None, 2),
    }[hidden]
    read[frames, bodies] = np.nan
    assert not value(read) < 0.9 * visible  # it is NaN if nothing is left to measure


def overlap(places):
    """Two bodies of 0.2 m overlap by what this is above 0.2 m."""
    return 0.4 - np.abs(places[:, 0, 0] - places[:, 1, 0])


def test_a_length_that_is_not_found_is_lost():
    physics = Physics(constants=(Constant("rod", "length", level, 0.1),))
    read = np.where(np.arange(FRAMES) < 5, 1.0, np.nan)
    seen = clip(physics, states={"level": np.ones(FRAMES)}, read={"level": read})
    assert LengthError().per_frame(seen).tolist() == [0] * 5 + [1] * 5
    assert LengthError().coverage(seen, np.zeros(FRAMES)) == 0.5
    assert Violations().value(seen) == 1


def test_one_clip_in_200_may_err_more():
    errors = np.random.default_rng(0).permutation(400) / 400
    assert worst(errors) == 397 / 400
    assert worst(errors[:50]) == errors[:50].max()


def test_the_true_frame_standing_still_breaks_no_law():
    read = {"level": np.full(FRAMES, 0.7)}  # misread alike in every frame
    seen = clip(AMOUNT, states={"level": np.ones(FRAMES)}, read=read)
    assert AmountError().value(seen) == pytest.approx(0.3)
    assert Violations().value(seen) == 1
    still = replace(seen, video=torch.zeros_like(seen.video))
    assert Violations().value(still) == 0
    assert Violations().per_frame(still).tolist() == [0] * FRAMES
    other = replace(seen, video=torch.ones_like(seen.video))
    assert Violations().value(other) == 1  # only the given frame is beyond doubt
