"""Contact events from distances against events that are known."""

import numpy as np
import pytest

from acwm_core.env.physics import Gap, Physics, Reading
from acwm_metrics.calibrate import best_touch, f1_score
from acwm_metrics.contact import (
    WINDOW,
    ContactPrecision,
    ContactRecall,
    ContactTiming,
    ContactTimingInFrames,
    beginnings,
    matched,
)
from tests.metrics.seeing import boxes, clip

FRAMES = 60
PHYSICS = Physics(
    gaps=(Gap("pair", ("a", "b"), lambda seen, start: seen.states["gap"], touch=0.01),)
)


def touching(*spans):
    found = np.zeros(FRAMES, bool)
    for first, last in spans:
        found[first : last + 1] = True
    return found


def seen(predicted, true):
    """A clip in which the bodies 1 and 2 touch in some frames of the prediction and the truth."""
    contacts = [(frame, 1, 2) for frame in np.flatnonzero(true)]
    gap = {"gap": np.where(predicted, 0.0, 0.1)}
    return clip(PHYSICS, states={"gap": np.zeros(FRAMES)}, read=gap, contacts=contacts, names="ab")


def test_true_contacts_are_all_right():
    true = touching((5, 9), (30, 33))
    for metric, best in ((ContactPrecision, 1), (ContactRecall, 1), (ContactTiming, 0)):
        assert metric().value(seen(true, true)) == best
        assert metric().weight(seen(true, true)) == 2


def test_one_missed_one_invented_one_late():
    prediction = seen(touching((8, 9), (50, 51)), touching((5, 9), (30, 33)))
    assert ContactPrecision().value(prediction) == 0.5
    assert ContactRecall().value(prediction) == 0.5
    assert ContactTiming().value(prediction) == pytest.approx(0.3)
    assert ContactTimingInFrames().value(prediction) == 3
    assert np.flatnonzero(~np.isnan(ContactRecall().per_frame(prediction))).tolist() == [5, 30]
    assert ContactPrecision().per_frame(prediction)[[8, 50]].tolist() == [1, 0]


def test_too_late_is_not_the_same_contact():
    prediction = seen(touching((11, 20)), touching((5, 20)))
    assert ContactPrecision().value(prediction) == ContactRecall().value(prediction) == 0
    assert np.isnan(ContactTiming().value(prediction))


def test_no_event_is_no_score_and_no_weight():
    prediction = seen(touching(), touching((0, 20)))  # being in contact at first is no event
    assert np.isnan(ContactRecall().value(prediction))
    assert ContactRecall().weight(prediction) == 0


def test_a_contact_of_what_is_not_found_is_missed_and_wrong():
    """b vanishes before its second contact; the truth shows it to the end."""
    bodies = Physics(
        readings=(Reading("place", "position", ("a", "b")),),
        gaps=(Gap("pair", ("a", "b"), lambda seen, start: seen.states["place"][:, 1], touch=0.01),),
    )
    true = touching((5, 9), (30, 33))
    place = np.stack([np.zeros(FRAMES), np.where(true, 0.0, 0.1)], 1)
    read, contacts = place.copy(), [(frame, 1, 2) for frame in np.flatnonzero(true)]
    read[20:, 1] = np.nan
    for masks, precision in ((boxes(FRAMES, (2, 2), (9, 9)), 0.5), (boxes(FRAMES, (2, 2)), 1.0)):
        given = {"true": masks, "states": {"place": place}, "read": {"place": read}, "names": "ab"}
        lost = clip(bodies, contacts=contacts, **given)
        assert ContactPrecision().value(lost) == precision
        assert ContactRecall().value(lost) == 0.5
    lost = clip(bodies, contacts=contacts, **given | {"true": boxes(FRAMES, (2, 2), (9, 9))})
    assert ContactTimingInFrames().value(lost) == (0 + WINDOW) / 2
    assert ContactTiming().coverage(lost, read) == pytest.approx((60 + 20) / 120)


def test_the_summary_is_that_of_all_events():
    metric = ContactPrecision()
    clips = [
        seen(touching((5, 9)), touching((5, 9))),
        seen(touching((5, 6), (20, 21), (40, 41)), touching((5, 6))),
    ]
    values, weights = [metric.value(c) for c in clips], [metric.weight(c) for c in clips]
    assert metric.summarise(values, weights) == pytest.approx(2 / 4)


def test_bodies_that_part_for_a_moment_have_not_parted():
    assert beginnings(touching((5, 6), (9, 12), (30, 30), (40, 42))).tolist() == [5, 30, 40]
    assert beginnings(touching((0, 2), (8, 9))).tolist() == [8]
    assert beginnings(touching()).tolist() == []


def test_nearest_beginnings_belong_together_each_once():
    assert sorted(matched(np.array([10, 13]), np.array([12, 30]))) == [(1, 0)]
    assert sorted(matched(np.array([10, 13]), np.array([12, 9]))) == [(0, 1), (1, 0)]


def test_the_threshold_is_found_between_contact_and_none():
    rng = np.random.default_rng(0)
    contact = touching((10, 20), (30, 31), (45, 50))
    gap = np.where(contact, rng.uniform(0, 0.01, FRAMES), rng.uniform(0.03, 1, FRAMES))
    pairs = [(gap, contact)]
    assert f1_score(pairs, best_touch(pairs)) == 1
    assert f1_score(pairs, 0.001) < 1
