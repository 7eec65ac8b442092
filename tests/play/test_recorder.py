"""Recordings as datasets, which can be read whatever the recorder is doing."""

import os

import numpy as np
import pytest

from acwm_core.data.card import CARD
from acwm_core.data.dataset import EpisodeDataset
from acwm_formats.check import check_dataset
from acwm_play.recorder import PlayedEpisode, save
from acwm_play.simulator import TimeStep
from tests import tiny

CARD_OF_WORLD = tiny.Drift.card


def time_step(place):
    frame = np.full((32, 32, 3), place, np.uint8)
    factors = {"colour": 200, "ground": 30}
    state = {"position": np.full(2, place, np.float64)}
    action = np.full(2, place and 1, np.float32)
    return TimeStep(frame, frame[..., 0] * 0, state, ((0, 1),), factors, None, action)


def recording(frames):
    return PlayedEpisode([time_step(n) for n in range(frames)], [time_step(0).frame] * frames)


@pytest.fixture(autouse=True, scope="module")
def world():
    tiny.register()


def problems(folder):
    return [each.problem for each in check_dataset(folder) if each.problem]


def test_the_dataset_can_be_read_at_every_moment_of_a_recording(tmp_path, monkeypatch):
    """Before and after each file takes its final name."""
    folder, _, _ = save(recording(3), CARD_OF_WORLD, tmp_path)
    sync, replace, read = os.fsync, type(folder).replace, []

    def look():
        dataset = EpisodeDataset(folder, "train")
        read.append([len(dataset[index].actions) for index in range(len(dataset))])

    def looking(what):
        def done(*given):
            result = what(*given)
            look()
            return result

        return done

    monkeypatch.setattr(os, "fsync", looking(sync))
    monkeypatch.setattr(type(folder), "replace", looking(replace))
    save(recording(5), CARD_OF_WORLD, tmp_path)
    assert read[0] == [3]
    assert read[-1] == [3, 5]
    assert {len(each) for each in read} == {1, 2}


def test_after_a_kill_the_next_recording_takes_the_place(tmp_path, monkeypatch):
    folder, _, _ = save(recording(3), CARD_OF_WORLD, tmp_path)
    before = (folder / CARD).read_bytes()

    class Killed(BaseException):
        """Like a signal that nothing catches."""

    def killed(*_):
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr("acwm_core.data.card.DatasetCard.write", killed)
        with pytest.raises(Killed):
            save(recording(4), CARD_OF_WORLD, tmp_path)
    assert (folder / CARD).read_bytes() == before
    assert problems(folder) == ["shard-00001.tar does not belong to the dataset"]
    save(recording(5), CARD_OF_WORLD, tmp_path)
    assert problems(folder) == []
    assert EpisodeDataset(folder, "train").lengths == [3, 5]
