"""`acwm policy train`: what is learnt, what a file holds, and what a killed command leaves."""

import csv
import json
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from acwm_core.cli import main
from acwm_core.errors import DataError, MissingExtraError, RecipeError
from acwm_core.training.run import load_run
from acwm_planning.policies.networks import layers_of, network_of
from acwm_planning.policies.saved import SavedPolicy, raw_actions
from acwm_policy.lesson import begin_episodes, prepare
from acwm_policy.settings import PolicySettings, settings_of
from acwm_policy.train import load_checkpoint
from tests import tiny
from tests.extras import needs
from tests.learning.world import straight

ROOT = Path(__file__).parents[2]

SMALL = {
    "learning_rate": 3e-3,
    "batch_size": 64,
    "policy_kwargs": {"net_arch": [32, 32]},
}


def train(run, out, *, steps, algorithm="sac", parameters=SMALL, **options):
    from acwm_policy.train import train_policy

    settings = PolicySettings(algorithm=algorithm, parameters=dict(parameters))
    options = {"scenes": 8, "starts": 16, "device": "cpu", **options}
    return train_policy(run, "slide.place", settings=settings, out=out, steps=steps, **options)


@needs("stable_baselines3")
@pytest.mark.parametrize("algorithm", ["sac", "ppo", "td3"])
def test_the_file_acts_as_the_learner_does(run, algorithm):
    """Without the library, the saved network gives the library's own deterministic actions."""
    bundle = load_run(run)
    begun = begin_episodes(bundle.card, 1, tiny.PLACE, 2)
    learner = PolicySettings(algorithm).learner()
    learner.begin(prepare(bundle, tiny.PLACE, begun, "dream", 2), 0)
    observed = np.random.default_rng(0).normal(0, 3, (50, 6)).astype(np.float32)
    wanted, _ = learner._model.predict(observed, deterministic=True)
    network = learner.network()
    with torch.no_grad():
        found = network_of(layers_of(network), network.state_dict())(torch.from_numpy(observed))
    assert np.abs(found.clamp(-1, 1).numpy() - wanted).max() < 1e-5
    assert np.ptp(wanted) > 0.01


FEW = {
    "sac": {**SMALL, "learning_starts": 16, "gradient_steps": 1},
    "ppo": {**SMALL, "n_steps": 8},
    "td3": {**SMALL, "learning_starts": 16, "gradient_steps": 1},
    "backprop": {"net_arch": [16], "horizon": 2},
}


@pytest.mark.parametrize(
    "algorithm",
    [pytest.param(a, marks=needs("stable_baselines3")) if a != "backprop" else a for a in FEW],
)
def test_a_killed_training_ends_as_one_that_was_not(run, tmp_path, monkeypatch, algorithm):
    """It is killed after its second checkpoint, and the same command gives the same policy."""
    from acwm_policy import train as module

    class Killed(BaseException):
        pass

    wanted = {"steps": 320, "algorithm": algorithm, "parameters": FEW[algorithm]}
    whole = train(run, tmp_path / "whole", **wanted)
    save, saved = module._Keeper.save, []

    def save_and_die(self):
        save(self)
        saved.append(self)
        if len(saved) == 2:
            raise Killed

    monkeypatch.setattr(module._Keeper, "save", save_and_die)
    with pytest.raises(Killed):
        train(run, tmp_path / "policy", **wanted)
    monkeypatch.setattr(module._Keeper, "save", save)
    policy = train(run, tmp_path / "policy", **wanted)
    assert policy.card.training["steps"] == whole.card.training["steps"] >= 320
    one, other = (each._network.state_dict() for each in (policy, whole))
    assert all(torch.equal(one[name], other[name]) for name in one)
    curves = [[*csv.reader((tmp_path / name / "curve.csv").open())] for name in ("policy", "whole")]
    assert curves[0][0] == ["steps", "success", "return", "error", "cpu_seconds"]
    kept, usual = ([row[:-1] for row in curve] for curve in curves)
    assert kept == usual
    assert len(kept) > 3


@needs("stable_baselines3")
@pytest.mark.parametrize("place", ["dream", "simulator"])
@pytest.mark.parametrize("other", [True, False], ids=["another model", "the same model"])
def test_what_passed_in_the_dream_of_another_model_is_not_learnt_from(run, tmp_path, other, place):
    """The steps of the simulator stay true whatever the model; the scale of observations stays."""
    model = tmp_path / "model"
    shutil.copytree(run, model)
    if other:
        path = model / "model.safetensors"
        with safe_open(path, "pt") as file:
            facts = {**(file.metadata() or {}), "another": "model"}
        save_file(load_file(path), path, facts)
    options = {"parameters": FEW["sac"], "place": place}
    first = train(run, tmp_path / "first", steps=160, **options)
    second = train(model, tmp_path / "second", steps=320, after=tmp_path / "first", **options)
    assert second.card.inputs == first.card.inputs
    kept = load_checkpoint(tmp_path / "second" / "checkpoint.pt")["learner"]["buffer"]
    forgets = other and place == "dream"
    assert 8 * len(kept["rewards"]) == second.card.training["steps"] - 160 * forgets


KILLED = """
import os, signal, sys
from pathlib import Path
from acwm_policy import train as module
from tests.learning import world
from tests.learning.test_training import FEW, train

world.register()
save, saved = module._Keeper.save, []

def save_and_die(self):
    save(self)
    saved.append(self)
    if len(saved) == 2 and sys.argv[3] == "dies":
        os.kill(os.getpid(), signal.SIGKILL)

module._Keeper.save = save_and_die
run, out = map(Path, sys.argv[1:3])
train(run, out, steps=320, algorithm="backprop", parameters=FEW["backprop"])
"""


@pytest.mark.ci
def test_a_process_that_is_killed_loses_nothing(run, tmp_path):
    """By SIGKILL, in processes of their own: the same bits as of one that lived."""

    def ends(name, fate):
        command = [sys.executable, "-c", KILLED, str(run), str(tmp_path / name), fate]
        return subprocess.run(command, check=False, cwd=ROOT, capture_output=True).returncode

    assert ends("killed", "dies") == -signal.SIGKILL
    assert 0 < SavedPolicy.read(tmp_path / "killed").card.training["steps"] < 320
    assert ends("killed", "lives") == ends("whole", "lives") == 0
    one, other = (
        SavedPolicy.read(tmp_path / name)._network.state_dict() for name in ("killed", "whole")
    )
    assert all(torch.equal(one[name], other[name]) for name in one)


@needs("stable_baselines3")
def test_it_trains_in_the_simulator_and_no_other_policy_goes_on(run, tmp_path):
    few = {**SMALL, "learning_starts": 8}
    options = {"steps": 24, "parameters": few, "place": "simulator", "scenes": 2}
    policy = train(run, tmp_path / "policy", **options)
    assert policy.card.training["place"] == "simulator"
    assert policy.card.inputs.state == {"position": [2]}
    with pytest.raises(DataError, match="holds a policy with another place, seed: choose another"):
        train(run, tmp_path / "policy", **{**options, "place": "dream", "seed": 1})


@needs("stable_baselines3")
@pytest.mark.ci
def test_it_learns_to_go_straight_to_the_goal(run, tmp_path):
    """In the dream alone; in the simulator it solves nearly what the best policy solves."""
    from acwm_policy.evaluate import evaluate_policy

    few = {**SMALL, "gradient_steps": 2, "learning_starts": 256, "gamma": 0.95}
    train(run, tmp_path / "policy", steps=5000, scenes=16, starts=64, parameters=few)
    found = evaluate_policy(tmp_path / "policy", seeds=range(30), run=run, device="cpu")
    share = {row["row"]: row["successes"] for row in found["rows"]}
    best = evaluate_policy(straight(tmp_path / "best"), seeds=range(30), run=run, device="cpu")
    (most,) = (row["successes"] for row in best["rows"] if row["row"] == "trained")
    assert share["trained"] >= 0.85 * most
    assert share["random"] < 0.6 * most


@needs("stable_baselines3")
def test_parameters_are_those_of_the_algorithm():
    found = settings_of(["algorithm=td3", "policy_delay=3", "observe=[position]", "bonus=2"])
    assert found == PolicySettings("td3", ["position"], 2.0, {"policy_delay": 3})
    nested = settings_of(["learning_rate=1e-3", "policy_kwargs.net_arch=[8]"])
    assert nested.parameters == {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [8]}}
    for words, said in {
        "learnin_rate=1": "sac has no parameter 'learnin_rate'; did you mean 'learning_rate'",
        "policy_delay=3": "it has learning_rate, buffer_size",
        "batch_size=big": "batch_size=big: expected int",
        "algorithm=sacc": "there is no algorithm 'sacc'; did you mean 'sac'?",
        "policy_kwargs.activation_fn=relu": "of policy_kwargs only net_arch can be set",
        "env=reacher": "sac has no parameter 'env'",
    }.items():
        with pytest.raises(RecipeError) as refused:
            settings_of([words])
        assert said in str(refused.value)


def test_without_the_library_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "acwm_policy.library", raising=False)
    with pytest.raises(MissingExtraError, match=r"pip install 'acwm\[policies\]'"):
        settings_of([])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train reach", "give ENVIRONMENT.TASK, such as reacher.reach"),
        ("train slide.place one two", "give one model, not one, two"),
        ("evaluate nowhere", "there is no policy's folder nowhere"),
    ],
)
def test_wrong_words_are_one_sentence(capsys, words, said):
    with pytest.raises(SystemExit) as ended:
        main(["policy", *words.split()])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_actions_are_in_the_units_of_the_card():
    low, high = np.array([-2.0, 0.0]), np.array([2.0, 10.0])
    found = raw_actions(torch.tensor([[-1.0, 0.0], [3.0, -7.0], [0.5, 1.0]]), low, high)
    assert found.tolist() == [[-2, 5], [2, 0], [1, 10]]


def test_a_damaged_policy_is_refused(tmp_path):
    with pytest.raises(DataError, match="holds no policy"):
        SavedPolicy.read(tmp_path)
    (tmp_path / "policy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(DataError, match="is no policy of this version"):
        SavedPolicy.read(tmp_path)
    whole = SavedPolicy.read(straight(tmp_path / "policy"))
    narrow = replace(whole.card.inputs, change=[1.0])
    SavedPolicy(replace(whole.card, inputs=narrow), nn.Linear(6, 2)).save(tmp_path)
    with pytest.raises(DataError, match="is no policy of this version"):
        SavedPolicy.read(tmp_path)


def test_settings_are_written_as_they_were_given(tmp_path):
    from acwm_policy.train import _opened

    with _opened(tmp_path / "policy", {"seed": 1}):
        assert json.loads((tmp_path / "policy" / "settings.json").read_text()) == {"seed": 1}
