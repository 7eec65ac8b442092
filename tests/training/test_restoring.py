"""A checkpoint of sound bytes that training did not write: one sentence, and no file removed."""

import contextlib
import os
import random
import shutil

import pytest
import torch

from acwm_core.errors import AcwmError, TrainingError
from acwm_core.training.launch import fit
from acwm_core.training.run import RunFolder
from tests.training.test_fit import killable, killed_run, weights
from tests.training.tiny import Kill
from tests.trust.mutating import EVIL, places

OFTEN = {"validate_every_n_steps": 1, "checkpoint_every_n_steps": 1}


@pytest.fixture(scope="module")
def stopped(data, tmp_path_factory):
    """A run that was stopped after some steps and validations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Kill, "batch", 6)
        folder = tmp_path_factory.mktemp("stopped") / "run"
        return killed_run(data, folder, patch, training=OFTEN).path


def resumed(data, stopped, folder, change):
    """Resume a copy of the run after a change of its checkpoint."""
    run = RunFolder(shutil.copytree(stopped, folder))
    checkpoint = torch.load(run.last_checkpoint, weights_only=True)
    change(checkpoint)
    torch.save(checkpoint, run.last_checkpoint)
    return fit(killable(data, trainer={"max_steps": 9}, training=OFTEN), "", resume=run.path)


def best_of(checkpoint):
    """What the callback keeps that knows the best checkpoint."""
    (state,) = (s for n, s in checkpoint["callbacks"].items() if n.startswith("ModelCheckpoint"))
    return state


def at(*path, value):
    """A change of one value, or its loss."""

    def change(checkpoint):
        for key in path[:-1]:
            checkpoint = checkpoint[key]
        if value is KeyError:
            del checkpoint[path[-1]]
        else:
            checkpoint[path[-1]] = value

    return change


PROGRESS = ("loops", "fit_loop", "epoch_loop.batch_progress")
ADAM = ("optimizer_states", 0)
WRONG = [
    *(at(name, value=KeyError) for name in ("loops", "state_dict", "optimizer_states")),
    at("pytorch-lightning_version", value="none"),
    at(*PROGRESS, "total", "ready", value="six"),
    at(*PROGRESS, "current", value=[1]),
    at("loops", "fit_loop", "epoch_progress", value=None),
    at("callbacks", value=["x"]),
    at("state_dict", value={"world_model.model.enter.weight": torch.zeros(1)}),
    at(*ADAM, "param_groups", 0, "lr", value="fast"),
    at(*ADAM, "param_groups", 0, "params", value=[0]),
    at(*ADAM, "state", 0, "exp_avg", value=torch.zeros(3)),
    at(*ADAM, "state", 0, "exp_avg", value=torch.zeros(())),
    at(*ADAM, "state", 0, "exp_avg", value=1.0),
    at(*ADAM, "state", 1, "exp_avg_sq", value=KeyError),
    at("lr_schedulers", 0, "base_lrs", value=["x", "y"]),
    at("lr_schedulers", 0, "optimizer", value="mine"),
    at("ClipData", "clips_per_step", value=None),
]


@pytest.mark.parametrize("change", WRONG)
def test_what_is_missing_or_of_another_kind_is_one_sentence(data, stopped, tmp_path, change):
    with pytest.raises(TrainingError, match=r"last\.ckpt|this run takes None clips") as raised:
        resumed(data, stopped, tmp_path / "run", change)
    assert "\n" not in str(raised.value)


def test_an_error_after_the_first_step_is_not_the_checkpoints(data, stopped, tmp_path, monkeypatch):
    monkeypatch.setattr(Kill, "batch", 8)
    with pytest.raises(Kill.error):
        resumed(data, stopped, tmp_path / "run", lambda checkpoint: None)


def test_moments_that_share_memory_are_given_their_own(data, stopped, tmp_path):
    """A fused optimiser writes as many numbers as the weight has, from the first one on."""
    plain = at(*ADAM, "state", 0, "exp_avg", value=torch.zeros(8, 4))
    shared = at(*ADAM, "state", 0, "exp_avg", value=torch.zeros(()).expand(8, 4))
    one, other = (
        RunFolder(resumed(data, stopped, tmp_path / name, change))
        for name, change in (("plain", plain), ("shared", shared))
    )
    assert weights(one).keys() == weights(other).keys()
    assert all(torch.equal(weights(one)[name], value) for name, value in weights(other).items())


@pytest.mark.parametrize("prefix", ["", "local://", "local::", "HOME/../", "HOME/x::local://"])
def test_a_checkpoint_has_no_files_of_others_removed(data, stopped, tmp_path, prefix):
    """Lightning removes the best checkpoint so far, where its state says that it is."""
    mine, home = tmp_path / "mine", tmp_path / "run/checkpoints"
    mine.mkdir()
    (mine / "work.txt").write_text("a year of work")
    where = os.path.relpath(mine, home) if ".." in prefix else mine
    path = f"{prefix.replace('HOME/..', str(home) + '/.').replace('HOME', str(home))}{where}"

    def change(checkpoint):
        state = best_of(checkpoint)
        worst = torch.tensor(1e9)
        state.update(best_k_models={path: worst}, kth_best_model_path=path, kth_value=worst)
        state.update(best_model_path=path)
        state.pop("dirpath")
        if prefix == "":
            state["dirpath"] = str(home)

    resumed(data, stopped, tmp_path / "run", change)
    assert (mine / "work.txt").read_text() == "a year of work"
    assert (home / "best.ckpt").is_file()


def test_the_best_checkpoint_is_still_known_after_a_resume(data, stopped, tmp_path):
    """In the folder where it was made; its state is then as Lightning wrote it."""
    run = RunFolder(shutil.copytree(stopped, tmp_path / "run"))

    def best(folder):
        checkpoint = torch.load(folder / "checkpoints/last.ckpt", weights_only=True)
        state = best_of(checkpoint)
        return state

    checkpoint = torch.load(run.last_checkpoint, weights_only=True)
    state = best_of(checkpoint)
    path, least = str(run.checkpoints / "best.ckpt"), torch.tensor(0.0)  # never to be beaten
    state.update(dirpath=str(run.checkpoints), best_k_models={path: least}, kth_value=least)
    state.update(best_model_path=path, kth_best_model_path=path, best_model_score=least)
    torch.save(checkpoint, run.last_checkpoint)
    before = (run.checkpoints / "best.ckpt").read_bytes()
    fit(killable(data, trainer={"max_steps": 9}, training=OFTEN), "", resume=run.path)
    assert best(run.path)["best_model_score"] == 0
    assert (run.checkpoints / "best.ckpt").read_bytes() == before


def replaced(seed):
    """One value of a checkpoint, but for the weights, replaced at random."""

    def change(checkpoint):
        draw = random.Random(seed)
        kept = {key: value for key, value in checkpoint.items() if key != "state_dict"}
        path = draw.choice([each for each in places(kept) if each])
        at(*path, value=draw.choice([KeyError, torch.zeros(2), *EVIL]))(checkpoint)

    return change


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(150))
def test_any_value_may_be_replaced(data, stopped, tmp_path, seed):
    with contextlib.suppress(AcwmError):
        resumed(data, stopped, tmp_path / "run", replaced(seed))
