"""Training that starts from the weights of another run."""

import shutil
from dataclasses import replace

import pytest
import torch

from acwm_core.data.card import DatasetCard
from acwm_core.errors import AcwmWarning, TrainingError
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.callbacks import Kill
from tests.training.runs import assert_same, killable, killed_run


@pytest.fixture(scope="module")
def first(data, tmp_path_factory):
    return fit(tiny_recipe(data, trainer={"max_steps": 3}), tmp_path_factory.mktemp("runs") / "a")


def started_from(first, **training):
    return {"training": {"init_from": str(first), "ema_decay": 0.0, **training}}


def state(run):
    world_model = load_run(run).world_model
    return {**world_model.model.state_dict(), **world_model.conditioner.state_dict()}


def test_it_starts_where_the_other_ended(first, data, tmp_path):
    changes = started_from(first, learning_rate=1e-12, warmup_steps=0, seed=5)
    run = fit(tiny_recipe(data, trainer={"max_steps": 1}, **changes), tmp_path / "b")
    for name, tensor in state(first).items():
        torch.testing.assert_close(state(run)[name], tensor, rtol=0, atol=1e-7)


def test_a_resumed_run_no_longer_needs_the_other(first, data, tmp_path, monkeypatch):
    copy = tmp_path / "first"
    shutil.copytree(first, copy)
    changes = started_from(copy)
    whole = RunFolder(fit(killable(data, **changes), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 8)
    stopped = killed_run(data, tmp_path / "stopped", monkeypatch, **changes)
    shutil.rmtree(copy)
    fit(killable(data, **changes), tmp_path / "unused", resume=stopped.path)
    assert_same(stopped, whole)


def test_weights_that_do_not_fit_are_refused(first, data, tmp_path):
    changes = {**started_from(first), "model": {"width": 6}}
    with pytest.raises(
        TrainingError,
        match=r"embed.*; model.width was 8, is 6; .*ignore_mismatched_sizes=true",
    ):
        fit(tiny_recipe(data, **changes), tmp_path / "run")
    with pytest.raises(TrainingError, match="another codec"):
        fit(tiny_recipe(data, **started_from(first), codec={"gain": 3.0}), tmp_path / "run")
    with pytest.raises(TrainingError, match="nowhere: there is no run with trained weights"):
        fit(tiny_recipe(data, **started_from(tmp_path / "nowhere")), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_weights_that_fit_are_taken_if_the_others_may_be_new(first, data, tmp_path):
    sections = {
        "training": {
            **started_from(first, learning_rate=1e-12, warmup_steps=0)["training"],
            "ignore_mismatched_sizes": True,
        },
        "codec": {"gain": 3.0},
    }
    same = fit(tiny_recipe(data, trainer={"max_steps": 1}, **sections), tmp_path / "same")
    for name, tensor in state(first).items():
        torch.testing.assert_close(state(same)[name], tensor, rtol=0, atol=1e-7)
    sections["model"] = {"width": 6}
    with pytest.warns(
        AcwmWarning, match="initialised randomly, because .* has none that fit"
    ) as told:
        other = fit(tiny_recipe(data, trainer={"max_steps": 1}, **sections), tmp_path / "other")
    before, after = state(first), state(other)
    fitting = {name for name in after if before[name].shape == after[name].shape}
    assert 0 < len(fitting) < len(after)
    for name in fitting:
        torch.testing.assert_close(after[name], before[name], rtol=0, atol=1e-7)
    message = next(str(each.message) for each in told if "has none that fit" in str(each.message))
    assert all(name in message for name in {*after} - fitting)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"fps": 30}, "the data has 30 frames/s, but .* was trained with 10 frames/s"),
        ({"names": ("dy", "dx")}, "the actions dy, dx in this order"),
        ({"names": ("vx", "vy")}, "the actions vx, vy, but"),
        ({"units": ("m", "px")}, "dx in m, but .* with dx in px"),
        ({"kind": "velocity"}, "actions of the kind velocity, but .* the kind delta"),
    ],
)
def test_weights_of_other_actions_or_another_rate_are_refused(changed, said, first, data, tmp_path):
    before = relabelled(data, tmp_path / "data", **changed)
    recipe = tiny_recipe(before, **started_from(first))
    with pytest.raises(TrainingError, match=said):
        fit(recipe, tmp_path / "run")
    anyway = tiny_recipe(
        before, trainer={"max_steps": 1}, **started_from(first, ignore_mismatched_sizes=True)
    )
    with pytest.warns(AcwmWarning, match=said):
        fit(anyway, tmp_path / "run")


def test_other_bounds_are_reported(first, data, tmp_path):
    wider = relabelled(data, tmp_path / "data", low=(-8.0, -4.0))
    recipe = tiny_recipe(wider, trainer={"max_steps": 1}, **started_from(first))
    with pytest.warns(AcwmWarning, match="the bounds of the actions differ from those of"):
        fit(recipe, tmp_path / "run")


def relabelled(data, folder, **changed):
    """The same episodes under another description."""
    shutil.copytree(data, folder)
    card = DatasetCard.read(folder)
    environment = card.environment
    rate = {name: changed.pop(name) for name in ("fps",) if name in changed}
    action = replace(environment.action, **changed)
    replace(card, environment=replace(environment, action=action, **rate)).write(folder)
    return folder
