"""What a dataset tells about itself, on recordings whose properties are known."""

import re

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.survey.following import _delay
from acwm_formats.survey.survey import SURE, short_form, survey
from acwm_report import data_page
from acwm_report.data_page import write_data_report
from tests.folders import damage_episode

ACTION = ActionSpec(("down", "right"), ("px", "px"), (-4, -4), (4, 4), "delta")


def blob(seed, frames=40, late=0):
    """A soft spot that goes where the actions say, so many frames late; the actions are smooth."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(frames + 10, 2))
    steps = np.zeros_like(noise)
    for t in range(1, len(noise)):
        steps[t] = 0.8 * steps[t - 1] + 0.6 * noise[t]
    steps = np.clip(steps[10:], -3, 3)
    moved = np.concatenate([np.zeros((max(late, 0), 2)), steps])[: frames - 1]
    if late < 0:
        moved = np.concatenate([steps[-late:], np.zeros((-late, 2))])[: frames - 1]
    places = 16 + np.concatenate([np.zeros((1, 2)), moved.cumsum(0)])
    y, x = np.mgrid[:32, :32]
    apart = [(np.abs(y - p) - 16) ** 2 + (np.abs(x - q) - 16) ** 2 for p, q in places % 32]
    light = np.exp(-(32 - np.sqrt(np.stack(apart)) - 9.5).clip(0) / 3) * 200
    video = np.repeat(light[..., None], 3, -1) + rng.normal(20, 2, (frames, 32, 32, 3))
    return Recording(video.clip(0, 255).astype(np.uint8), steps[: frames - 1])


def written(out, train, test=(), action=ACTION, **more):
    splits = {"train": train, **({"ind_test": test} if test else {})}
    write_dataset(out, splits, name="blob", action=action, fps=10, progress=False, **more)
    return out


def texts(found, level):
    return " | ".join(each.text for each in found.findings if each.level == level)


@pytest.mark.parametrize("late", [0, 1, 3, -1])
def test_the_delay_is_found(tmp_path, late):
    found = survey(written(tmp_path, [blob(n, late=late) for n in range(16)]))
    assert found.following.delay == late
    assert found.following.confidence > 0.9
    assert min(found.following.read) > 0.5
    assert (f"--shift {late}" in texts(found, "bad")) == (late != 0)


def test_nothing_follows_exchanged_actions(tmp_path):
    right = [blob(n) for n in range(16)]
    other = [Recording(a.video, right[n - 1].actions) for n, a in enumerate(right)]
    found = survey(written(tmp_path, other))
    assert not found.following.follows
    assert found.following.delay is None
    assert "Nothing" in texts(found, "bad")


def test_actions_that_all_episodes_share_show_nothing(tmp_path):
    """Noise that grows at the same time in all, and actions that do: only the time is common."""
    rng = np.random.default_rng(0)
    course = np.sin(np.arange(40) / 3)
    frames = [
        (100 + 40 * course[:, None, None, None] + rng.normal(0, 9, (40, 32, 32, 3))).astype(
            np.uint8
        )
        for _ in range(16)
    ]
    made = [Recording(f, course[:-1, None] + rng.normal(0, 0.1, (39, 2))) for f in frames]
    assert not survey(written(tmp_path, made)).following.follows


def test_what_is_wrong_with_actions_is_said(tmp_path):
    train = [blob(n) for n in range(6)]
    for each in train:
        each.actions[:, 1] = 0.5
    train[2].actions[7, 0] = 1000.0
    wide = ActionSpec(("down", "right"), ("px", "px"), (-4, -4), (1000, 4), "delta")
    found = survey(written(tmp_path, train, action=wide))
    assert [each.constant for each in found.actions] == [False, True]
    assert found.actions[0].most == 1000
    assert sum(found.actions[0].counts) == 6 * 39
    assert "down has outliers" in texts(found, "bad")
    assert "--bounds quantile" in texts(found, "bad")
    assert "constant: right" in texts(found, "note")


def test_defective_frames_are_counted(tmp_path):
    rng = np.random.default_rng(0)
    still = rng.integers(0, 256, (30, 32, 32, 3), dtype=np.uint8)
    dark, twice, frozen, soft, red = (still.copy() for _ in range(5))
    dark[3:5] = 0
    red[9] = (200, 0, 0)
    twice[11] = twice[10]
    frozen[10:24] = frozen[10]
    soft[20] = soft[20].mean((0, 1)) + 0.1 * (soft[20] - soft[20].mean((0, 1)))
    acts = rng.uniform(-1, 1, (29, 2))
    videos = (still, dark, twice, frozen, soft, red)
    facts = survey(written(tmp_path, [Recording(v, acts) for v in videos])).frames
    counts = facts.frames, facts.dark, facts.flat, facts.repeated, facts.frozen, facts.blurred
    assert counts == (180, 2, 1, 1, 13, 1)
    assert facts.examples["dark"] == [("train", 1, 3), ("train", 1, 4)]
    assert facts.examples["blurred"] == [("train", 4, 20)]


def test_what_goes_away_leaves_no_blur(tmp_path):
    """A square that is always there, and five that are there in most frames."""
    frames = np.full((30, 48, 48, 3), 255, np.uint8)
    frames[:, 20:28, 20:28] = (200, 80, 80)
    frames[:20, 4:12, 4:12] = frames[:20, 4:12, 20:28] = frames[:20, 4:12, 36:44] = (200, 80, 80)
    frames[:20, 36:44, 4:12] = frames[:20, 36:44, 20:28] = (200, 80, 80)
    acts = np.random.default_rng(0).uniform(-1, 1, (29, 2))
    assert survey(written(tmp_path, [Recording(frames, acts)])).frames.blurred == 0


def told(*means):
    """What each of the delays −5 … 5 tells, in 60 episodes."""
    return np.array(means)[:, None] + np.random.default_rng(0).normal(0, 0.02, (11, 60))


def test_a_weak_first_change_leaves_the_delay_uncertain():
    """A torque held for long: all later changes tell of it, the first one least."""
    assert _delay(told(0, 0, 0, 0, 0, 0.01, 0.08, 0.06, 0.05, 0.03, 0.02), range(-5, 6))[1] < SURE


def test_frames_that_a_policy_answered_are_no_delay():
    delay = _delay(told(0.02, 0, 0, 0, 0, 0.04, 0.08, 0.06, 0.05, 0.03, 0.02), range(-5, 6))
    assert delay == (0, pytest.approx(1, abs=0.05))


def test_test_episodes_that_were_trained_on_are_found(tmp_path):
    train = [blob(n) for n in range(5)]
    near = Recording(train[3].video // 2 * 2, train[3].actions)
    found = survey(written(tmp_path, train, [blob(7), near]))
    assert [(each.episode, each.trained) for each in found.near_duplicates] == [(1, 3)]
    assert "1 of 2 test episodes" in texts(found, "bad")


def test_a_small_dataset_has_a_report_too(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    found = survey(written(tmp_path, [Recording(frames, np.ones((2, 2)))]))
    assert found.following is None
    assert write_data_report(found, tmp_path / "page.html").exists()


@pytest.mark.ci
def test_the_page_and_the_command(tmp_path, monkeypatch):
    data = written(tmp_path / "data", [blob(n) for n in range(6)], [blob(9)])
    done = CliRunner().invoke(main, ["data", "report", str(data)])
    assert done.exit_code == 0, done.output
    page = (data / "report.html").read_text()
    assert page.count("<video") == 6
    assert all(
        each.startswith(("data:", "#")) for each in re.findall(r'(?:src|href)="([^"]*)"', page)
    )
    assert "http" not in page.replace("http-equiv", "")
    assert "6 training episodes" in page
    assert short_form(survey(data))[0][2:] in done.output


def test_what_a_strangers_card_says_is_text(tmp_path):
    evil = "<script>alert(1)</script>"
    action = ActionSpec((evil, "right"), (evil, "px"), (-4, -4), (4, 4), "delta")
    data = written(tmp_path / "data", [blob(n) for n in range(6)], action=action, summary=evil)
    page = write_data_report(survey(data), tmp_path / "page.html").read_text()
    assert evil not in page
    assert page.count("<script>") == 1


def test_measured_needs_become_a_table(tmp_path, monkeypatch):
    (tmp_path / "needs.yaml").write_text(
        "rows:\n- {world: reacher, episodes: 2048, psnr: 30.125, response: 0.5, psnr_started: 31}\n"
        "- {world: reacher, episodes: 32, psnr: 20, response: 0.1}\n"
    )
    monkeypatch.setattr(data_page.resources, "files", lambda _: tmp_path)
    table = data_page.needs_table()
    assert [[cell.text for cell in row.cells] for row in table.rows] == [
        ["20.00", "0.10", "–"],
        ["30.12", "0.50", "31.00"],
    ]
    assert [row.title for row in table.rows] == ["32", "2,048"]


@pytest.mark.ci
def test_episodes_that_cannot_be_read_do_not_end_the_report(tmp_path):
    data = written(tmp_path / "data", [blob(n) for n in range(4)], [blob(5), blob(6)])
    damage_episode(data, "train", 1)
    damage_episode(data, "ind_test", 0, "actions.npy")
    found = survey(data)
    assert [*found.unread.places] == [("train", 1), ("ind_test", 0)]
    assert "2 of 6 episodes looked at cannot be read, e.g. train 1" in texts(found, "bad")
    assert write_data_report(found, tmp_path / "page.html").read_text().count("<video") == 4
    drawn = CliRunner().invoke(main, ["data", "preview", str(data)])
    assert drawn.exit_code == 0
    for index, split in enumerate(["train"] * 4 + ["ind_test"] * 2):
        place = index % 4
        if (split, place) != ("ind_test", 0):  # a second change would mend it
            damage_episode(data, split, place, "actions.npy")
    with pytest.raises(DataError, match="none of the 6 episodes looked at can be read"):
        survey(data)
