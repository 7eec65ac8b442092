"""Overlap and outlines of masks, by counting."""

import numpy as np
import pytest

from acwm_core.env.physics import Level, Physics
from acwm_metrics.shape import HeightError, MaskIoU, OutlineError
from tests.metrics.seeing import SIDE, boxes, clip

NAMES = ("a", "b")
SOLID = Physics(objects=NAMES)
TRUE = boxes(4, (2, 2), (20, 20))


def test_equal_masks_overlap_wholly():
    assert MaskIoU().value(clip(SOLID, true=TRUE, names=NAMES)) == 1


def test_a_shifted_object_overlaps_by_the_share_that_is_counted():
    seen = boxes(4, (2, 4), (20, 20))  # of 6 columns, 4 are shared and 8 covered by either
    assert MaskIoU().value(clip(SOLID, seen=seen, true=TRUE, names=NAMES)) == pytest.approx(
        (4 / 8 + 1) / 2
    )


def test_what_vanished_and_what_should_not_be_there_count_with_nothing():
    seen = boxes(4, (2, 2), None)
    assert MaskIoU().value(clip(SOLID, seen=seen, true=TRUE, names=NAMES)) == 0.5
    assert MaskIoU().value(clip(SOLID, seen=TRUE, true=seen, names=NAMES)) == 0.5


def test_outlines_are_as_far_apart_as_they_were_moved():
    shaped = Physics(shapes=("a",))
    bar = np.zeros((3, SIDE, SIDE), np.uint8)
    bar[:, :, 10:18] = 1  # from border to border, so that only its two sides move
    moved = np.roll(bar, 2, axis=2)
    scores = OutlineError().per_frame(clip(shaped, seen=moved, true=bar, names=("a",)))
    inside = 2 * 2 * (SIDE - 2) - 2  # the sides are 2 px off, but 1 px beside the shared ends
    ends = 2 * (2 + 1)  # of the eight in the first and the last row all but two are shared
    assert scores == pytest.approx(np.full(3, (inside + ends) / (2 * (SIDE - 2) + 2 * 8)))
    assert OutlineError().value(clip(shaped, true=bar, names=("a",))) == 0


def test_an_outline_that_is_not_found_counts_as_it_was_last_seen():
    shaped = Physics(shapes=("a",))
    bar = np.zeros((3, SIDE, SIDE), np.uint8)
    bar[0, :, 10:18] = bar[1, :, 12:20] = bar[2, :, 14:22] = 1
    for frames, kept in (([0, 1], [0, 1, 1]), ([], [0, 0, 0])):  # the given frame is always known
        seen = np.zeros_like(bar)
        seen[frames] = bar[frames]
        held = OutlineError().per_frame(clip(shaped, seen=bar[kept], true=bar, names=("a",)))
        lost = clip(shaped, seen=seen, true=bar, names=("a",))
        assert OutlineError().per_frame(lost).tolist() == held.tolist()
        assert OutlineError().coverage(lost, held) == pytest.approx(len(frames) / 3)
    hidden = clip(shaped, seen=0 * bar, true=0 * bar, names=("a",))
    assert np.isnan(OutlineError().value(hidden))


def test_height_errors_are_the_mean_over_all_places():
    levels = (
        Level("sand", lambda seen, start: seen.states["sand"]),
        Level("water", lambda seen, start: seen.states["water"]),
    )
    true = {"sand": np.zeros((2, 3)), "water": np.full((2, 1), 0.5)}
    seen = {
        "sand": np.array([[0.03, -0.03, 0.0], [0.01, 0.02, np.nan]]),
        "water": np.array([[0.4], [np.nan]]),
    }
    scores = HeightError().per_frame(clip(Physics(levels=levels), states=true, read=seen))
    assert scores == pytest.approx([(0.03 + 0.03 + 0.1) / 4, 0.015])
