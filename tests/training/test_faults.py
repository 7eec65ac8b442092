"""What goes wrong in the middle of a training, or with what it left, is one sentence."""

import io
import json
import multiprocessing
import os
import re
import shutil
import struct
import zipfile
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.errors import AcwmError, DataError, TrainingError
from acwm_core.files import held
from acwm_core.plugins import catalog
from acwm_core.training.checkpoints import read_details
from acwm_core.training.fit import fit
from acwm_core.training.run import RunFolder, load_run, read_metadata
from tests.plugins import plugin_of
from tests.tiny import TinyModel, tiny_recipe
from tests.training.callbacks import Kill
from tests.training.test_fit import killable, killed_run, weights


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    return RunFolder(fit(tiny_recipe(data), tmp_path_factory.mktemp("runs") / "whole"))


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


def test_a_run_that_another_command_trains_is_not_judged_by_its_files(data, tmp_path, monkeypatch):
    monkeypatch.setattr(Kill, "batch", 1)
    run = killed_run(data, tmp_path / "run", monkeypatch)  # no checkpoint yet
    monkeypatch.setattr("acwm_core.files.ENDING_SECONDS", 0.0)
    for resume in (None, "auto"):
        with held(run.path), pytest.raises(DataError, match="another command is writing to"):
            fit(killable(data), run.path, resume=resume)


def test_a_run_folder_that_is_removed_is_one_sentence(data, tmp_path):
    remove = {
        "class_path": "tests.training.faults.Remove",
        "init_args": {"folder": str(tmp_path / "run")},
    }
    with pytest.raises(TrainingError, match=r"run was removed or moved while it was trained"):
        fit(tiny_recipe(data, trainer={"callbacks": [remove]}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("workers", [0, 1])
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
    kill = {"class_path": "tests.training.faults.KillWorker", "init_args": {"batch": batch}}
    recipe = tiny_recipe(data, data={"workers": 1}, trainer={"callbacks": [kill]})
    with pytest.raises(AcwmError, match=r"a process that reads data died.*resume=auto"):
        fit(recipe, tmp_path / "run")
    monkeypatch.setenv("SPARED", "1")
    assert fit(recipe, tmp_path / "run", resume="auto")  # what it advises


def test_workers_leave_ctrl_c_to_the_training(data):
    """From their first moment on: they start with the signal blocked."""
    clips = ClipDataset(EpisodeDataset(data, "train"), frames=9, stride=2)
    loader = iter(ClipLoader(clips, ClipSampler(len(clips), batch_size=2), workers=2))
    next(loader)
    (main, *workers) = [os.getpid(), *(each.pid for each in multiprocessing.active_children())]
    assert len(workers) == 2
    masks = [Path(f"/proc/{pid}/status").read_text() for pid in (main, *workers)]
    blocked = [int(re.search("SigBlk:\\s*(\\w+)", mask)[1], 16) >> 1 & 1 for mask in masks]
    assert blocked == [0, 1, 1]


def test_a_damaged_checkpoint_is_named(data, tmp_path, monkeypatch):
    monkeypatch.setattr(Kill, "batch", 5)
    run = killed_run(data, tmp_path / "run", monkeypatch)
    whole = run.last_checkpoint.read_bytes()
    run.last_checkpoint.write_bytes(whole[:1000])
    with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
        fit(killable(data), "", resume=run.path)
    places = []
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        for info in archive.infolist():
            lengths = struct.unpack_from("<HH", whole, info.header_offset + 26)
            places.append(info.header_offset + 30 + sum(lengths))
    assert len(places) > 20
    for place in places:  # the first byte of every tensor, and of what PyTorch pickles
        damaged = bytearray(whole)
        damaged[place] ^= 0x40
        run.last_checkpoint.write_bytes(damaged)
        with pytest.raises(TrainingError, match=r"last\.ckpt is damaged"):
            fit(killable(data), "", resume=run.path)


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
