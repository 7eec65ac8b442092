"""Training beside a command that makes its data: what is there, then what was added, exactly on."""

import shutil

import pytest
import torch

from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.errors import DataError, RecipeError
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.callbacks import Kill, Killed
from tests.training.runs import assert_same, killable

BATCH = 4
GROWING = {"growing": True, "validation_episodes": 2, "batch_size": BATCH}
"""Two episodes of a shard of four are held out; each of the others gives two clips of nine frames
of its twelve."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The finished data: ten shards of four episodes."""
    folder = tmp_path_factory.mktemp("made") / "data"
    episodes = {"train": 40}
    generate("tiny_world", folder, episodes=episodes, workers=0, shard_episodes=4, progress=False)
    return folder


@pytest.fixture
def show(made, tmp_path):
    """A function that shows the data as it is when some of its shards are finished."""
    folder = shutil.copytree(made, tmp_path / "data")
    lines = (folder / "train" / "manifest.jsonl").read_text().splitlines(keepends=True)

    def shown(*shards):
        (folder / "train" / "manifest.jsonl").write_text("".join(lines[k] for k in shards))
        return folder

    return shown


def recipe(data, steps, **asked):
    trainer = {"max_steps": steps}
    return killable(data, data={**GROWING, **asked}, trainer=trainer)


def passes(run):
    state = torch.load(run.last_checkpoint, weights_only=True)
    return state["GrowingClipData"]["passes"]


@pytest.mark.parametrize("cached", [True, False])
def test_each_pass_takes_what_is_finished_and_a_resumed_one_what_it_took(
    cached, show, tmp_path, monkeypatch
):
    asked = {"cache_latents": cached}
    run = RunFolder(fit(recipe(show(0, 1, 2), 3, **asked), tmp_path / "run"))
    clips = passes(run)[0][2]
    assert passes(run) == [[0, 12, clips]]
    first = clips // BATCH
    whole = RunFolder(shutil.copytree(run.path, tmp_path / "whole"))
    killed = RunFolder(shutil.copytree(run.path, tmp_path / "killed"))

    data = show(0, 1, 2, 3, 4, 5)
    end = first + 8
    fit(recipe(data, end, **asked), tmp_path / "unused", resume=whole.path)
    assert [each[:2] for each in passes(whole)] == [[0, 12], [clips, 24]]

    monkeypatch.setattr(Kill, "batch", first + 6)
    with pytest.raises(Killed):
        fit(recipe(data, end, **asked), tmp_path / "unused", resume=killed.path)
    monkeypatch.setattr(Kill, "batch", None)
    assert len(passes(killed)) == 2
    fit(recipe(show(*range(10)), end, **asked), tmp_path / "unused", resume=killed.path)
    assert passes(killed) == passes(whole)
    assert_same(whole, killed)


def test_shards_that_follow_an_unfinished_one_wait(show):
    episodes = EpisodeDataset(show(0, 1, 3), "train", growing=True)
    assert len(episodes) == 8
    assert episodes.checksum == EpisodeDataset(show(*range(10)), "train", growing=True).checksum
    assert episodes.checksum != EpisodeDataset(show(*range(10)), "train").checksum


def test_what_cannot_grow_or_has_not_begun_is_refused(show, tmp_path):
    with pytest.raises(DataError, match="no shard"):
        EpisodeDataset(show(1), "train", growing=True)
    held = {"growing": True, "validation_episodes": 4}
    with pytest.raises(DataError, match="first 4 are held out"):
        fit(tiny_recipe(show(0), data=held), tmp_path / "run")
    with pytest.raises(DataError, match="growing"):
        EpisodeDataset(show(0), "train")
    card = DatasetCard.read(show(0))
    recorded = DatasetCard.from_dict({**card.to_dict(), "source": {"kind": "videos", "name": "a"}})
    recorded.write(show(0))
    with pytest.raises(DataError, match="cannot grow"):
        EpisodeDataset(show(0), "train", growing=True)


@pytest.mark.parametrize("other", [{"fraction": 0.5}, {"reader": "webdataset"}])
def test_a_part_or_a_stream_of_what_grows_is_refused(other):
    with pytest.raises(RecipeError, match=r"data\.growing"):
        DataConfig("data", growing=True, **other)


def test_a_run_whose_data_was_taken_away_says_so(show, tmp_path):
    run = RunFolder(fit(recipe(show(0, 1, 2), 3), tmp_path / "run"))
    with pytest.raises(DataError, match="was trained on 12"):
        fit(recipe(show(0, 1), 5), tmp_path / "unused", resume=run.path)
