"""Training on transformed clips: all of them, cached or not, and exactly on after a kill."""

from dataclasses import replace

import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import DataError
from acwm_core.training.data import ClipData
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import TinyCodec, tiny_recipe
from tests.training.callbacks import Kill
from tests.training.runs import assert_same, killable, killed_run

ASKED = {"symmetries": True}


@pytest.fixture
def mirrored(tmp_path):
    """Data whose card declares the mirror image; the tiny world has it, as it has no walls."""
    folder = tmp_path / "data"
    generate("tiny_world", folder, episodes={"train": 8}, workers=0, progress=False)
    card = DatasetCard.read(folder)
    mirror = Symmetry((1, -2), mirrored=True)
    replace(card, environment=replace(card.environment, symmetries=(mirror,))).write(folder)
    return folder


@pytest.mark.parametrize("cached", [True, False])
def test_a_killed_run_resumes_on_the_same_transformed_clips(
    cached, mirrored, tmp_path, monkeypatch
):
    asked = {"data": {**ASKED, "cache_latents": cached}}
    whole = RunFolder(fit(killable(mirrored, **asked), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 7)
    run = killed_run(mirrored, tmp_path / "run", monkeypatch, **asked)
    fit(killable(mirrored, **asked), tmp_path / "unused", resume=run.path)
    assert_same(whole, run)


def test_training_takes_every_version_and_validation_only_what_was_recorded(mirrored):
    config = DataConfig(str(mirrored), clip_frames=9, window_stride=2, **ASKED, cache_latents=False)
    data = ClipData(config, EpisodeDataset(mirrored, "train"), TinyCodec(), 0)
    data.setup("fit")
    versions = [data._train.version(index) for index in range(len(data._train))]
    assert versions.count(None) == len(versions) / 2
    assert data._validation.versions == (None,)


def test_data_without_symmetries_is_refused(data, tmp_path):
    with pytest.raises(DataError, match="declares no symmetries of tiny_world"):
        fit(tiny_recipe(data, data=ASKED), tmp_path / "run")
    assert not (tmp_path / "run").exists()
