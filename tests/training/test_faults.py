"""What goes wrong in the middle of a training, or with what it left, is one sentence."""

import json
import shutil

import pytest
from safetensors.torch import load_file, save_file

from acwm_core.errors import AcwmError, DataError, TrainingError
from acwm_core.files import held
from acwm_core.plugins import catalog
from acwm_core.training.checkpoints import read_details
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run, read_metadata
from acwm_core.training.run_folder import RunFolder
from tests.plugins import plugin_of
from tests.tiny import TinyModel, tiny_recipe
from tests.training.faults import KillWorker
from tests.training.runs import killable, weights


@pytest.mark.parametrize("part", ["world_model", "averaged"])
def test_weights_that_are_not_finite_reach_no_file(part, data, tmp_path):
    spoil = {"class_path": "tests.training.faults.Spoil", "init_args": {"part": part, "step": 7}}
    run = RunFolder(tmp_path / "run")
    recipe = tiny_recipe(data, trainer={"callbacks": [spoil]}, training={"ema_decay": 0.0})
    with pytest.raises(TrainingError, match=r"not finite in step .*last\.ckpt is the last good"):
        fit(recipe, run.path)
    assert read_details(run.last_checkpoint)["global_step"] == 6
    assert all(value.isfinite().all() for value in weights(run).values())
    assert load_run(run.path).world_model is not None


def test_a_validation_that_is_not_finite_stops_the_run(data, tmp_path):
    spoil = {
        "class_path": "tests.training.faults.Spoil",
        "init_args": {"part": "averaged", "step": 8},
    }
    often = {"checkpoint_every_n_steps": 100, "validate_every_n_steps": 4}
    recipe = tiny_recipe(data, trainer={"callbacks": [spoil]}, training=often)
    with pytest.raises(TrainingError, match=r"val/loss is not finite in step 8 \(nothing was"):
        fit(recipe, tmp_path / "run")


@pytest.mark.parametrize("resume", [None, "auto"])
def test_a_run_that_another_command_trains_is_not_judged_by_its_files(
    resume, data, tmp_path, monkeypatch
):
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.setattr("acwm_core.files.ENDING_SECONDS", 0.0)
    with held(run), pytest.raises(DataError, match="another command is writing to"):
        fit(killable(data), run, resume=resume)
    assert [each.name for each in run.iterdir()] == [".lock"]


def test_a_run_folder_that_is_removed_is_one_sentence(data, tmp_path):
    remove = {
        "class_path": "tests.training.faults.Remove",
        "init_args": {"folder": str(tmp_path / "run")},
    }
    with pytest.raises(TrainingError, match=r"run was removed or moved during training"):
        fit(tiny_recipe(data, trainer={"callbacks": [remove]}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_latents_that_are_cut_off_under_a_training_are_one_sentence(workers, data, tmp_path):
    """A map of such a file would end the process, or its worker, by SIGBUS."""
    copy = shutil.copytree(data, tmp_path / "data")
    cut = {"class_path": "tests.training.faults.CutLatents", "init_args": {"data": str(copy)}}
    recipe = tiny_recipe(copy, data={"workers": workers}, trainer={"callbacks": [cut]})
    with pytest.raises(DataError, match=r"damaged \(its end is cut off\)") as raised:
        fit(recipe, tmp_path / "run")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("batch", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_a_worker_that_is_killed_is_one_sentence(batch, data, tmp_path, monkeypatch):
    """Workers start with Ctrl-C blocked, so that they leave it to the training."""
    kill = {"class_path": "tests.training.faults.KillWorker", "init_args": {"batch": batch}}
    recipe = tiny_recipe(data, data={"workers": 1}, trainer={"callbacks": [kill]})
    with pytest.raises(AcwmError, match=r"a process that reads data died.*resume=auto"):
        fit(recipe, tmp_path / "run")
    assert KillWorker.blocked
    recipe = tiny_recipe(data, trainer={"callbacks": [kill]})
    monkeypatch.setenv("SPARED", "1")
    assert fit(recipe, tmp_path / "run", resume="auto")  # what it advises


def test_a_damaged_checkpoint_is_named(whole, data, tmp_path):
    """By its checksums, before anything of it is read."""
    run = RunFolder(shutil.copytree(whole.path, tmp_path / "run"))
    content = bytearray(run.last_checkpoint.read_bytes())
    content[content.find(weights(whole)["world_model.model.enter.weight"].numpy().tobytes())] ^= (
        0x40
    )
    run.last_checkpoint.write_bytes(content)
    with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
        fit(killable(data, trainer={"max_steps": 20}), "", resume=run.path)


def test_weights_are_compared_with_their_checksum(whole, tmp_path):
    run = RunFolder(shutil.copytree(whole.path, tmp_path / "run"))
    data = bytearray(run.weights.read_bytes())
    data[-100:-96] = b"\0\0\0\x3f"
    run.weights.write_bytes(data)
    with pytest.raises(TrainingError, match=r"model\.safetensors is damaged: its checksum"):
        load_run(run.path)
    facts = read_metadata(whole.weights)
    del facts["sha256"]  # as in runs of old
    save_file(load_file(whole.weights), run.weights, {"acwm": json.dumps(facts)})
    assert load_run(run.path).world_model is not None


class Broadcast(TinyModel):
    """Predicts one latent frame, which would count for all."""

    def forward(self, latents, sigma, conditioning):
        return super().forward(latents, sigma, conditioning)[:, :1]


class Detached(TinyModel):
    """Learns nothing."""

    def forward(self, latents, sigma, conditioning):
        return super().forward(latents, sigma, conditioning).detach()


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Broadcast", r"4, 1, 3, 2, 2.*4, 5, 3, 2, 2"),
        ("Detached", "the loss of Detached has no gradient"),
    ],
)
def test_a_model_that_cannot_learn_is_told_before_the_first_step(name, sentence, data, tmp_path):
    known = {each.name for each in catalog().registry("model")}
    if name.lower() not in known:
        parts = plugin_of(models={name.lower(): f"{__name__}:{name}"})
        catalog().add_plugin(parts, f"parts_{name}")
    with pytest.raises(AcwmError, match=sentence):
        fit(tiny_recipe(data, model={"name": name.lower()}), tmp_path / "run")
