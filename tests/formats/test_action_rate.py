"""Actions that come more often than frames: summed right, told, and asked about."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.video import write_mp4
from acwm_formats.alignment import Alignment, align
from acwm_formats.survey.action_rate import ActionRate, followed
from acwm_formats.survey.following import Moments
from acwm_formats.survey.motion import small
from tests.formats.spots import FPS, spot

RATES = (1, 1.3, 2, 2.5, 50 / 12, 7, 10)
RHYTHMS = ("even", "jitter", "irregular", "pairs")


def episode(given, kind, **options):
    found = align(given.recording, ["top"], Alignment(kinds=(kind,) if kind else (), **options))
    return found, found.episodes[0]


@pytest.mark.parametrize("kind", ["velocity", "torque", "delta", "absolute"])
@pytest.mark.parametrize("rhythm", RHYTHMS)
@pytest.mark.parametrize("rate", RATES)
def test_actions_of_any_rate_become_what_happens_within_a_frame(rate, rhythm, kind):
    given = spot(1, kind, rate, rhythm, frames=24)
    if not episode(given, kind)[0].unused:
        assert (rate, rhythm) in ((1, "even"), (1, "jitter"))
        return
    ends = np.append(given.times, 2 * given.times[-1] - given.times[-2])
    rows = []
    for frame in range(23):
        start, stop = frame / FPS, (frame + 1) / FPS
        within = np.clip(np.minimum(ends[1:], stop) - np.maximum(ends[:-1], start), 0, None)
        shares = {
            "velocity": within * FPS,
            "torque": within * FPS,
            "delta": within / np.diff(ends),
            "absolute": np.arange(len(within)) == np.searchsorted(given.times, start, "right") - 1,
        }[kind]
        rows.append(shares @ given.actions)
    planned = episode(given, kind, tolerance=0.0)[1]
    first = int(planned.frames["top"][0])
    wanted = np.array(rows)[first : first + len(planned.actions) - 1]
    assert len(wanted) >= 20
    np.testing.assert_allclose(planned.actions[:-1], wanted, atol=1e-4)


@pytest.mark.parametrize("rate", [1.3, 2, 50 / 12, 10])
def test_it_is_measured_how_often_they_come(rate):
    found, _ = episode(spot(1, "absolute", rate), "")
    assert found.per_frame == pytest.approx(rate, rel=0.05)
    assert found.unused == pytest.approx(1 - 1 / rate, abs=0.03)
    assert episode(spot(1, "absolute", 1), "")[0].unused == 0


def pairs(kind, rate, rhythm, **more):
    """Stretches of twelve episodes with the values at the frames, and with their means."""
    values, sums = [], []
    for seed in range(12):
        given = spot(seed, kind, rate, rhythm, **more)
        held, mean = (episode(given, each)[1] for each in ("absolute", "velocity"))
        shown = mean.frames["top"]
        frames = small(given.video.transpose(0, 3, 1, 2))[shown]
        first = held.frames["top"].tolist().index(int(shown[0]))
        rows = slice(first, first + len(shown) - 1)
        values.append(Moments(("train", seed), 0, frames, held.actions[rows]))
        sums.append(Moments(("train", seed), 0, frames, mean.actions[:-1]))
    return values, sums


KINDS = [("absolute", "value"), ("velocity", "sum"), ("delta", "sum"), ("torque", "sum")]


def tell(kind, right, rate, rhythm, memory):
    found, _ = followed(*pairs(kind, rate, rhythm, memory=memory))
    assert found == right or (found == "" and (kind == "torque" or rate < 2))


@pytest.mark.parametrize(("kind", "right"), KINDS[:2])
def test_the_video_tells_whether_it_follows_values_or_sums(kind, right):
    tell(kind, right, 50 / 12, "irregular", 0.1)


def test_forces_are_never_taken_for_targets():
    """Their value at a frame tells more of what is new than their sum, which acts later."""
    tell("torque", "sum", 4, "even", 0.4)


LATE = [(10, "even", 0.1), (10, "irregular", 0.3), (5, "pairs", 0.8), (3, "irregular", 0.3)]


@pytest.mark.parametrize(("rate", "rhythm", "late"), LATE)
def test_targets_that_are_reached_late_are_never_taken_for_velocities(rate, rhythm, late):
    """The video follows their mean over a frame, but moves back as other targets replace them."""
    found, shares = followed(*pairs("absolute", rate, rhythm, memory=0.1, late=late))
    assert found != "sum"
    assert shares[1] > shares[0]  # the mean is read better than the value


def test_velocities_as_fast_are_still_told():
    assert followed(*pairs("velocity", 10, "irregular", memory=0.1))[0] == "sum"


def mixed(rate):
    """Stretches in which y is a target of the upper spot, and x a velocity of the lower one."""
    upper, lower = (pairs(kind, rate, "even", memory=0.2) for kind in ("absolute", "velocity"))
    return [
        [joined(one, other) for one, other in zip(ours, others[1:] + others[:1], strict=True)]
        for ours, others in zip(upper, lower, strict=True)
    ]


def joined(upper, lower):
    """One stretch of two, one below the other, with an action of each."""
    count = min(len(upper.actions), len(lower.actions))
    frames = [each.frames[: count + 1] for each in (upper, lower)]
    actions = [each.actions[:count, column] for column, each in enumerate((upper, lower))]
    return replace(upper, frames=np.concatenate(frames, 2), actions=np.stack(actions, 1))


def test_actions_of_several_kinds_are_told_apart():
    follows, shares = followed(*mixed(5))
    assert follows == "both"
    rate = ActionRate((5.0, 5.0), 0.8, ("absolute",), False, follows, shares)
    assert "a kind for each, in order" in rate.question
    assert "--action-kind delta,delta,absolute" in rate.question
    assert ActionRate.of_source(rate.to_source()) == rate


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.05, 0.3])
@pytest.mark.parametrize("rhythm", ["even", "irregular"])
@pytest.mark.parametrize("rate", [1.5, 50 / 12, 10])
@pytest.mark.parametrize(("kind", "right"), KINDS)
def test_it_tells_at_any_rate(kind, right, rate, rhythm, memory):
    tell(kind, right, rate, rhythm, memory)


def film(folder, kind, count=8, per_frame=50 / 12):
    """A folder of videos of 12 frames/s, with a table of actions and their times beside each."""
    folder.mkdir()
    for seed in range(count):
        given = spot(seed, kind, per_frame, memory=0.3, frames=60)
        write_mp4(folder / f"take {seed}.mp4", given.video, fps=FPS)
        begins = given.times >= 0
        rows = zip(given.times[begins], *given.actions[begins].T, strict=True)
        lines = ["time,x,y", *(f"{t:.4f},{x:.5f},{y:.5f}" for t, x, y in rows)]
        (folder / f"take {seed}.csv").write_text("\n".join(lines))
    return folder


def imported(folder, out, *words):
    words = ["data", "import", "videos", str(folder), "--out", str(out), "--workers", "0", *words]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    return " ".join(done.output.split()), DatasetCard.read(out)


@pytest.mark.ci
def test_velocities_that_are_held_are_asked_about(tmp_path):
    takes = film(tmp_path / "takes", "velocity")
    said, card = imported(takes, tmp_path / "held")
    assert "Actions come 4.2 times per frame; held: one of four is used." in said
    assert "✗ actions come 4.2 times per frame" in said
    assert "velocities or forces? Import again with --action-kind velocity" in said
    assert "--shift" not in said
    assert "--action-kind" not in card.source["command"]
    said, card = imported(takes, tmp_path / "right", "--action-kind", "velocity")
    assert "Actions come 4.2 times per frame; averaged over each frame." in said
    assert "✓ The video follows the actions, at once" in said
    assert "--action-kind velocity" in card.source["command"]


@pytest.mark.slow
def test_a_shift_certifies_nothing_that_is_open(tmp_path):
    takes = film(tmp_path / "takes", "velocity")
    said, _ = imported(takes, tmp_path / "shifted", "--shift", "-1")
    assert "✓ The video follows the actions" not in said
    assert "✗ actions come" in said


@pytest.mark.slow
def test_targets_that_are_held_are_asked_about_too(tmp_path):
    takes = film(tmp_path / "takes", "absolute")
    said, _ = imported(takes, tmp_path / "held")
    assert "· actions come 4.2 times per frame; held: one of four is used." in said
    assert "moves as their values change" in said
    said, _ = imported(takes, tmp_path / "stated", "--action-kind", "absolute")
    assert "Actions come 4.2 times per frame; held: one of four is used." in said
    assert "velocities or forces" not in said


@pytest.mark.ci
def test_frames_that_are_left_out_leave_out_actions(tmp_path):
    takes = film(tmp_path / "takes", "velocity", per_frame=1)
    assert "times per frame" not in imported(takes, tmp_path / "all")[0]
    assert (
        "Actions come 3.0 times per frame; held"
        in imported(takes, tmp_path / "few", "--fps", "4", "--test-episodes", "2")[0]
    )
