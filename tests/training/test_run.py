"""Loading a run: the averaged weights come back, and everything wrong is said in a sentence."""

import json
import shutil

import pytest
import safetensors.torch
import torch

from acwm_core.errors import TrainingError
from acwm_core.training import run
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run, load_weights, read_metadata, save_weights
from acwm_core.training.run_folder import RunFolder
from tests.tiny import TinyModel, tiny_recipe, tiny_world_model
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


def test_weights_that_training_replaces_meanwhile_are_those_before(tmp_path, monkeypatch):
    """An evaluation of a run that still trains called them damaged."""
    path, back = tmp_path / "model.safetensors", tiny_world_model(seed=3)
    models = [tiny_world_model(seed=1), tiny_world_model(seed=2)]

    def save(step):
        save_weights(path, models[step].state_dict(), back.codec.fingerprint(), step=step)

    def replaced(text):
        save(1)
        return json.loads(text)

    save(0)
    monkeypatch.setattr(run, "parse_json", replaced)
    load_weights(back, path)
    for name, value in models[0].state_dict().items():
        assert torch.equal(value, back.state_dict()[name])


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


@pytest.mark.parametrize(
    "facts",
    ["[]", "[" * 10**5, "9" * 5000, '{"format": 1}', '{"format": 1, "step": 3, "codec": [7]}', "x"],
)
def test_weights_that_say_odd_things_of_themselves(tmp_path, facts):
    path = tmp_path / "model.safetensors"
    safetensors.torch.save_file({"model.x": torch.zeros(1)}, path, metadata={"acwm": facts})
    with pytest.raises(TrainingError, match=r"not written by this version|cannot be read"):
        read_metadata(path)


def test_tied_weights_come_back(tmp_path):
    """Such as an embedding that is the output layer, too; safetensors refuses shared memory."""

    def tied(seed):
        world_model = tiny_world_model(seed)
        world_model.model.twin = torch.nn.Linear(4, 8)
        world_model.model.twin.weight = world_model.model.enter.weight
        return world_model

    there, back, path = tied(1), tied(2), tmp_path / "model.safetensors"
    save_weights(path, there.state_dict(), there.codec.fingerprint(), step=7)
    load_weights(back, path)
    assert torch.equal(back.model.enter.weight, there.model.enter.weight)
    assert back.model.twin.weight is back.model.enter.weight


@pytest.mark.parametrize(
    "value", [{"a": 1}, torch.eye(3).to_sparse(), torch.zeros(3, dtype=torch.complex32)]
)
def test_what_cannot_be_saved_is_refused_before_the_first_step(value, data, tmp_path, monkeypatch):
    monkeypatch.setattr(TinyModel, "get_extra_state", lambda self: value, raising=False)
    monkeypatch.setattr(TinyModel, "set_extra_state", lambda *_: None, raising=False)
    with pytest.raises(TrainingError, match=r"cannot be saved: .*model\._extra_state is a"):
        fit(tiny_recipe(data), tmp_path / "run")
    assert not (tmp_path / "run" / "metrics.csv").exists()


def test_the_scripts_default_precision_does_not_matter(whole):
    first, actions = torch.rand(1, 3, 16, 16), torch.rand(1, 9, 2)
    expected = load_run(whole.path).world_model.rollout(first, actions)
    torch.set_default_dtype(torch.float64)
    try:
        world_model = load_run(whole.path).world_model
        assert torch.equal(world_model.rollout(first, actions), expected)
        assert torch.equal(world_model.rollout(first.double(), actions.double()), expected)
    finally:
        torch.set_default_dtype(torch.float32)
