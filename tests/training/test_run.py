"""Loading a run: the averaged weights come back, and everything wrong is said in a sentence."""

import json
import shutil

import pytest
import safetensors.torch
import torch

from acwm_core.errors import TrainingError
from acwm_core.training.run import load_run, load_weights, read_metadata, save_weights
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_world_model
from tests.training.runs import killable


@pytest.fixture
def copy(whole, tmp_path):
    return RunFolder(shutil.copytree(whole.path, tmp_path / "copy"))


def test_loaded_model_is_the_average_of_the_last_step(whole):
    bundle = load_run(whole.path)
    saved = torch.load(whole.last_checkpoint, weights_only=True)["state_dict"]
    loaded = bundle.world_model.state_dict()
    for name in loaded:
        if not name.startswith("codec."):
            assert torch.equal(loaded[name], saved[f"averaged.{name}"])
    assert any(
        not torch.equal(saved[f"averaged.{name}"], saved[f"world_model.{name}"])
        for name in loaded
        if not name.startswith("codec.")
    )
    assert bundle.card.name == "tiny_world"
    assert bundle.recipe.to_dict() == killable(bundle.recipe.data["path"]).to_dict()
    assert not bundle.world_model.training


def test_round_trip_of_weights(tmp_path):
    there = tiny_world_model(seed=1)
    path = tmp_path / "model.safetensors"
    save_weights(path, there.state_dict(), there.codec.fingerprint(), step=7, note="x")
    back = tiny_world_model(seed=2)
    load_weights(back, path)
    first, actions = torch.rand(1, 3, 16, 16), torch.rand(1, 9, 2)
    assert torch.equal(back.eval().rollout(first, actions), there.eval().rollout(first, actions))
    facts = read_metadata(path)
    assert len(facts.pop("sha256")) == 64
    assert facts == {"format": 1, "step": 7, "codec": there.codec.fingerprint(), "note": "x"}


def test_the_codec_is_in_no_file_of_the_run(whole):
    checkpoint = torch.load(whole.last_checkpoint, weights_only=True)
    names = [*checkpoint["state_dict"], *safetensors.torch.load_file(whole.weights)]
    assert names
    assert not [name for name in names if "codec" in name or "mix" in name]


def test_damaged_or_foreign_weights_are_refused(copy):
    whole = copy.weights.read_bytes()
    copy.weights.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(TrainingError, match="cannot be read"):
        load_run(copy.path)
    for metadata in (None, {"acwm": json.dumps({"format": 99})}):
        safetensors.torch.save_file({"a": torch.zeros(1)}, copy.weights, metadata=metadata)
        with pytest.raises(TrainingError, match="not written by this version"):
            load_run(copy.path)


def test_folders_that_hold_no_run_are_refused(tmp_path, copy):
    with pytest.raises(TrainingError, match="there is no run folder"):
        load_run(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrainingError, match="is not a run"):
        load_run(tmp_path / "empty")
    copy.weights.unlink()
    with pytest.raises(TrainingError, match="no trained weights"):
        load_run(copy.path)
