"""Frames and actions are brought together by their times, and whatever disagrees is told."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest

from acwm_formats.alignment import Alignment, align
from acwm_formats.cadence import common_rate
from acwm_formats.timeline import Samples, TimedRecording

NTSC = Fraction(30000, 1001)


@dataclass(frozen=True)
class Moments:
    """Frames that nobody decodes."""

    times: np.ndarray


def recording(times, actions=None, *, samples=None, states=None, **claims):
    """A recording whose action i is (i, 2 i), unless others are given."""
    rows = np.arange(len(times)) if actions is None else np.asarray(actions)
    samples = samples or Samples(np.stack([rows, 2 * rows], 1))
    cameras = {"top": Moments(np.asarray(times, np.float64))}
    return TimedRecording("it", cameras, samples, states or {}, **claims)


def aligned(given, **options):
    return align(given, ["top"], Alignment(**options))


def only(found):
    """Places of frames and first dimension of the actions of the one episode, without defects."""
    assert found.defects == []
    (episode,) = found.episodes
    assert episode.actions.dtype == np.float32
    return episode.frames["top"].tolist(), episode.actions[:-1, 0].tolist()


def problem(found):
    (defect,) = found.defects
    return defect


@pytest.mark.parametrize(
    "times",
    [
        np.arange(1200) / 30,
        np.arange(1200) / float(NTSC),
        np.round(np.arange(1200) / float(NTSC), 3),  # as Matroska rounds
        1.7e9 + np.arange(1200) / 30,  # on the clock of a computer
        np.arange(1200) / 30 + np.random.default_rng(0).uniform(-0.008, 0.008, 1200),
        np.floor(np.arange(1200) * 2.5) / 60,  # films shown at 60 frames/s
    ],
    ids=["30", "ntsc", "rounded", "epoch", "jitter", "pulldown"],
)
def test_frames_of_a_constant_rate_keep_their_actions(times):
    frames, actions = only(aligned(recording(times)))
    assert frames == list(range(1200))
    assert actions == list(range(1199))


def test_a_claimed_rate_may_be_off_by_a_clocks_error_and_no_more():
    times = np.arange(1200) / float(NTSC)
    only(aligned(recording(times, rate=Fraction(30), length=1200)))
    slow = recording(times, rate=Fraction(60))
    assert "60" in problem(aligned(slow)).problem
    assert problem(aligned(slow)).option == "--fps"
    only(aligned(slow, fps=NTSC))


def test_a_lost_frame_is_filled_and_told():
    times = np.delete(np.arange(30) / 30, 7)
    found = aligned(recording(times, np.arange(30), length=30))
    frames, actions = only(found)
    assert frames == [*range(7), 6, *range(7, 29)]
    assert actions == list(range(29))
    assert any("1 missing of camera top" in note for note in found.notes)


def test_rows_of_the_frames_alone_stay_with_them():
    times = np.delete(np.arange(30) / 30, 7)
    frames, actions = only(aligned(recording(times)))
    assert frames == [*range(7), 6, *range(7, 29)]
    assert actions == [*range(7), 6, *range(7, 28)]


def test_a_long_gap_is_refused_or_parts_the_episode():
    times = np.delete(np.arange(30) / 30, [10, 11, 12, 13])
    found = aligned(recording(times, np.arange(30)))
    assert "missing for 0.167 s" in problem(found).problem
    assert "--max-gap" in problem(found).option
    parts = [(e.frames["top"].tolist(), e.actions[:-1, 0].tolist()) for e in found.episodes]
    assert parts == [
        (list(range(10)), list(range(9))),
        (list(range(10, 26)), list(range(14, 29))),
    ]
    frames, _ = only(aligned(recording(times, np.arange(30)), max_gap=4))
    assert frames[9:15] == [9, 9, 9, 9, 9, 10]


def test_a_late_start_counts_from_the_first_frame_or_from_zero():
    times = (2 + np.arange(12)) / 30
    assert only(aligned(recording(times))) == (list(range(12)), list(range(11)))
    found = aligned(recording(times, np.arange(14), length=14))
    assert only(found) == (list(range(12)), list(range(2, 13)))


def test_numbered_rows_stay_with_their_frames():
    numbers = np.array([0, 1, 2, 3, *range(6, 12)])
    rows = Samples(numbers[:, None], frames=numbers)
    found = aligned(recording(np.arange(12) / 10, samples=rows))
    _, actions = only(found)
    assert actions == [0, 1, 2, 3, 3, 3, 6, 7, 8, 9, 10]
    assert any("2 missing of action" in note for note in found.notes)
    assert "missing" in problem(aligned(recording(np.arange(12) / 10, samples=rows), max_gap=1))[1]
    shorter = aligned(recording(np.arange(10) / 10, samples=rows))
    assert {"12", "10"} <= set(problem(shorter).problem.split())


@pytest.mark.parametrize(("frames", "rows"), [(30, 28), (29, 31), (12, 1)])
def test_counts_that_disagree_are_told_with_both_numbers(frames, rows):
    defect = problem(aligned(recording(np.arange(frames) / 30, np.arange(rows))))
    assert {str(frames), str(rows)} <= set(defect.problem.split())
    assert defect.option == "--on-defect trim"
    claimed = problem(aligned(recording(np.arange(frames) / 30, length=rows)))
    assert {str(frames), str(rows)} <= set(claimed.problem.split())


def test_a_last_row_may_be_there_or_not():
    times = np.arange(10) / 10
    assert only(aligned(recording(times, np.arange(9)))) == only(aligned(recording(times)))


def test_times_that_stand_still_or_go_back_are_found():
    times = np.arange(12) / 10
    times[5] = times[4]
    assert "have the time of the frame before" in aligned(recording(times)).defects[0].problem
    times[5] = 0.05
    assert "goes back from 0.4 to 0.05" in aligned(recording(times)).defects[0].problem


def test_rows_with_times_are_taken_at_their_times():
    times = 100 + np.arange(20) / 10
    early = Samples(np.arange(50)[:, None], times=99 + np.arange(50) / 10)
    assert only(aligned(recording(times, samples=early)))[1] == list(range(10, 29))
    short = Samples(np.arange(10)[:, None], times=100.5 + np.arange(10) / 10)
    found = aligned(recording(times, samples=short))
    assert [d.problem.split(" of ")[0] for d in found.defects] == ["its first 5", "its last 4"]
    (part,) = found.episodes
    assert part.frames["top"].tolist() == list(range(5, 16))


def test_resampling_takes_the_latest_frame_and_treats_actions_by_their_kind():
    values = np.arange(30)
    rows = Samples(np.stack([values] * 4, 1))
    kinds = ("absolute", "velocity", "delta", "torque")
    found = aligned(
        recording(np.arange(30) / 30, samples=rows, rate=Fraction(30)),
        fps=Fraction(10),
        kinds=kinds,
    )
    assert found.defects == []
    (episode,) = found.episodes
    assert episode.frames["top"].tolist() == list(range(0, 30, 3))
    held = values[::3][:-1]
    mean = values.reshape(10, 3).mean(1)[:-1]
    expected = np.stack([held, mean, 3 * mean, mean], 1)
    np.testing.assert_allclose(episode.actions[:-1], expected, atol=1e-5)


def test_faster_and_slower_rows_meet_the_frames():
    times = np.arange(12) / 10
    fast = Samples(np.arange(120)[:, None], times=np.arange(120) / 100)
    _, held = only(aligned(recording(times, samples=fast)))
    assert held == [10 * i for i in range(11)]
    _, mean = only(aligned(recording(times, samples=fast), kinds=("velocity",)))
    np.testing.assert_allclose(mean, [10 * i + 4.5 for i in range(11)])
    slow = Samples(np.arange(4)[:, None], times=np.arange(4) * 0.3)
    assert only(aligned(recording(times, samples=slow)))[1] == [i // 3 for i in range(11)]


def test_any_times_can_be_resampled():
    times = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.09, 60))
    rows = Samples(np.arange(60)[:, None], times=times)
    assert aligned(recording(times, samples=rows)).defects[0].option == "--fps"
    found = aligned(recording(times, samples=rows), fps=Fraction(10), tolerance=0)
    frames, actions = only(found)
    grid = times[0] + np.arange(len(frames)) / 10
    right = [int(np.sum(times <= moment)) - 1 for moment in grid]
    assert (frames, actions) == (right, right[:-1])


@pytest.mark.parametrize("shift", [-2, 0, 3])
def test_a_shift_moves_actions_to_other_frames(shift):
    frames, actions = only(aligned(recording(np.arange(12) / 10), shift=shift))
    assert actions == [frame - shift for frame in frames[:-1]]
    assert len(frames) >= 12 - abs(shift)


def test_other_cameras_show_the_same_moments():
    first, second = np.arange(10) / 10, np.arange(30) / 30
    given = recording(first)
    cameras = {"top": Moments(first), "side": Moments(second)}
    given = TimedRecording("it", cameras, given.actions)
    found = align(given, ["top", "side"], Alignment())
    assert found.defects == []
    assert found.episodes[0].frames["side"].tolist() == list(range(0, 30, 3))


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (np.array(["a"] * 8), "not numbers"),
        (np.zeros((8, 2, 2)), "not [N, A]"),
        (np.zeros((0, 2)), "0 rows"),
        (np.where(np.arange(8) == 3, np.nan, 1.0), "row 3"),
    ],
)
def test_what_is_no_action_is_told(values, word):
    found = aligned(recording(np.arange(8) / 10, samples=Samples(values)))
    assert word in found.defects[0].problem


@pytest.mark.parametrize("kind", ["?", "i2", "u1", "f2", "f8"])
def test_numbers_of_any_type_are_actions(kind):
    rows = Samples((np.arange(8) % 2).astype(kind))
    found = aligned(recording(np.arange(8) / 10, samples=rows))
    assert only(found)[1] == [0, 1, 0, 1, 0, 1, 0]


def test_states_follow_the_frames_to_the_last():
    found = aligned(recording(np.arange(8) / 10, states={"s": Samples(np.arange(8))}))
    assert found.episodes[0].states["s"].tolist() == list(range(8))
    short = recording(np.arange(8) / 10, states={"s": Samples(np.arange(7))})
    assert {"7", "8"} <= set(problem(aligned(short)).problem.split())


def test_the_rate_of_a_dataset_is_exact():
    measured = [(29.969, 40.04), (30.1, 0.4)]
    assert common_rate(measured, [Fraction(30)]) == NTSC
    assert common_rate([(29.97, 1.0)], [Fraction(30)]) == 30
    assert common_rate([(14.9998, 20.0)], []) == 15
    assert common_rate([(12.5, 20.0)], []) == Fraction(25, 2)
