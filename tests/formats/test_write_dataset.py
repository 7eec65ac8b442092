"""`write_dataset`: a format of one's own becomes a dataset like any other."""

import contextlib
import errno
from fractions import Fraction

import numpy as np
import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.card import exact_rate
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError, ShapeError
from acwm_formats import staging
from acwm_formats.alignment import Alignment
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.check import check_dataset
from acwm_formats.format import export_dataset
from acwm_formats.lerobot import LeRobot
from acwm_formats.recordings import import_dataset
from tests.formats import release
from tests.formats.conftest import checksums

ACTION = ActionSpec(("up", "right"), ("m", "m"), (-1, -1), (1, 1), "delta")


class Mine:
    """Reads recording i when it is asked, and never holds two."""

    def __init__(self, count, seed=0, size=(40, 48)):
        self.count, self.seed, self.size = count, seed, size

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        rng = np.random.default_rng([self.seed, index])
        frames, actions = release.moving_square(rng, 6 + index, self.size)
        return Recording(frames, actions[:-1], {"step": np.arange(6 + index, dtype=np.int16)})


def write(out, splits, **changes):
    options = {"name": "mine", "action": ACTION, "fps": 5, "state": {"step": ""}} | changes
    return write_dataset(out, splits, progress=False, **options)


def test_recordings_become_a_dataset(tmp_path):
    card = write(tmp_path / "data", {"train": Mine(3), "ind_test": [Mine(4)[3]]})
    assert card.splits == {"train": 3, "ind_test": 1}
    assert (card.environment.frame_size, card.environment.fps) == ((40, 48), 5)
    assert card.environment.state[0].name == "step"
    assert card.command("x") == "the program that wrote it"
    for index, episode in enumerate(EpisodeDataset(tmp_path / "data", "train")):
        given = Mine(3)[index]
        np.testing.assert_array_equal(episode.video, given.video)
        np.testing.assert_array_equal(episode.actions[:-1], given.actions)
        assert not episode.actions[-1].any()
        np.testing.assert_array_equal(episode.states["step"], given.states["step"])
    assert [f for f in check_dataset(tmp_path / "data") if f.problem] == []


def test_workers_and_a_second_call_change_nothing(tmp_path):
    for workers in (0, 2):
        write(tmp_path / str(workers), {"train": Mine(3)}, workers=workers)
    before = checksums(tmp_path / "0")
    assert before == checksums(tmp_path / "2")
    write(tmp_path / "0", {"train": Mine(3)})
    assert checksums(tmp_path / "0") == before
    with pytest.raises(DataError, match="holds another dataset"):
        write(tmp_path / "0", {"train": Mine(3, seed=1)})


def test_arrays_that_do_not_fit_are_refused_unless_it_is_said_how(tmp_path):
    frames, actions = release.moving_square(np.random.default_rng(0), 9, (40, 48))
    times, steps = np.arange(9) / 5, {"step": np.arange(9)}
    dropped = np.delete(frames, 4, axis=0), np.delete(times, 4)
    lost = Recording(dropped[0], actions, {"step": np.arange(8)})
    with pytest.raises(DataError, match="action has 9 rows, and the video 8 frames"):
        write(tmp_path / "lost", {"train": [lost]})
    told = Recording(dropped[0], actions, steps, dropped[1], times)
    write(tmp_path / "told", {"train": [told]})
    episode = EpisodeDataset(tmp_path / "told", "train")[0]
    np.testing.assert_array_equal(episode.actions[:-1], actions[:-1])
    np.testing.assert_array_equal(episode.video, frames[[0, 1, 2, 3, 3, 5, 6, 7, 8]])
    short = [Recording(frames, actions[:4], steps), Recording(frames[:6], actions, steps)]
    write(tmp_path / "trim", {"train": short}, alignment=Alignment(on_defect="trim"))
    assert EpisodeDataset(tmp_path / "trim", "train").lengths == [5, 6]


@pytest.mark.parametrize("fps", [29.97, Fraction(30000, 1001), 30, 7.5])
def test_rates_are_kept_exactly(tmp_path, fps):
    card = write(tmp_path / "data", {"train": Mine(1)}, fps=fps)
    assert exact_rate(card.environment.fps) == Fraction(str(fps))
    assert DatasetCard.read(tmp_path / "data") == card
    assert (type(card.environment.fps) is int) == (fps == 30)
    export_dataset(tmp_path / "data", tmp_path / "lerobot", LeRobot(), progress=False)
    again = import_dataset(LeRobot().read(tmp_path / "lerobot"), tmp_path / "again", workers=0)
    assert again.environment.fps == card.environment.fps


def test_frames_can_shrink(tmp_path):
    card = write(tmp_path / "data", {"train": Mine(2)}, size=(24, 32))
    assert card.environment.frame_size == (24, 32)
    assert EpisodeDataset(tmp_path / "data", "train")[0].video.shape[1:] == (24, 32, 3)


@pytest.mark.parametrize(
    ("splits", "changes", "error", "problem"),
    [
        ({}, {}, DataError, "no recordings"),
        ({"train": []}, {}, DataError, "no recordings"),
        ({"tarin": Mine(1)}, {}, DataError, "did you mean 'train'"),
        ({"train": Mine(1)}, {"state": {"stop": ""}}, DataError, "did you mean 'step'"),
        ({"train": Mine(1)}, {"size": 60}, ShapeError, "multiple of 8"),
        ({"train": Mine(1)}, {"size": 64}, DataError, "cannot be enlarged"),
        ({"train": Mine(1, size=(8, 48))}, {}, DataError, "too small"),
        ({"train": Mine(1)}, {"fps": 0}, ShapeError, "is not a rate"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, splits, changes, error, problem):
    with pytest.raises(error, match=problem):
        write(tmp_path / "data", splits, **changes)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"video": np.full((6, 40, 48, 3), 7.5, np.float32)}, "--pixel-range"),
        ({"video": np.zeros((6, 40), np.uint8)}, "not uint8"),
        ({"video": np.zeros((1, 40, 48, 3), np.uint8)}, "1 usable frames"),
        ({"video": np.zeros((6, 16, 16, 3), np.uint8)}, r"16×16, and those of the first 40×48"),
        ({"actions": np.zeros((6, 3))}, "3 dimensions, not 2"),
        ({"actions": np.full((6, 2), 1.5)}, r"action up is 1\.5 in row 0, out of its bounds"),
        ({"actions": np.full((6, 2), np.nan)}, "not finite"),
        ({"states": {}}, "state step is None"),
        ({"states": {"step": np.zeros((6, 2))}}, r"state step is \(2,\)"),
        ({"states": {"step": np.array(["a"] * 6)}}, "step holds <U1"),
        ({"states": {"step": np.array([{}] * 6)}}, "step holds object"),
    ],
)
def test_a_recording_that_cannot_be_is_named(tmp_path, change, problem):
    good = Mine(3)[0]
    values = {"video": good.video, "actions": good.actions, "states": good.states} | change
    recordings = [good, Recording(**values), good]
    with pytest.raises(DataError, match=f"episode 1 of train: .*{problem}"):
        write(tmp_path / "data", {"train": recordings})
    recordings[1] = good  # fixed, it resumes
    assert write(tmp_path / "data", {"train": recordings}).splits == {"train": 3}
    assert DatasetCard.read(tmp_path / "data").source["kind"] == "python"


def test_a_refused_call_leaves_no_folder(tmp_path):
    good = Mine(2)
    bad = [good[0], Recording(good[1].video, good[1].actions[:-3], good[1].states)]
    with pytest.raises(DataError):
        write(tmp_path / "data", {"train": bad})
    assert not (tmp_path / "data").exists()
    assert write(tmp_path / "data", {"train": good}).splits == {"train": 2}


def test_a_full_disk_is_no_defect_of_recordings_to_leave_out(tmp_path, monkeypatch):
    written = staging.written_whole

    @contextlib.contextmanager
    def full(path):
        with written(path) as partial:
            yield partial
            raise OSError(errno.ENOSPC, "No space left on device", str(partial))

    monkeypatch.setattr(staging, "written_whole", full)
    with pytest.raises(DataError, match=r"cannot write to .*No space left"):
        write(tmp_path / "data", {"train": Mine(2)}, alignment=Alignment(on_defect="skip"))
