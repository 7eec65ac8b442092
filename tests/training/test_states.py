"""Training on the agent's states: which clips hold them, that it resumes, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import acwm
from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import ClipDataset, DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import AcwmError, DataError, RecipeError
from acwm_core.training.data import ClipData
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import TinyCodec, tiny_recipe
from tests.training.callbacks import Kill
from tests.training.runs import assert_same, killable, killed_run

PLACES = {"states": ["position"]}
LEARNER = {
    "model": {"name": "recurrent", "channels": 4, "width": 8},
    "objective": {"name": "regression"},
}


@pytest.fixture
def mirrored(tmp_path):
    """Data whose card says how mirroring changes places, rows and columns of 16 px."""
    folder = tmp_path / "data"
    generate("tiny_world", folder, episodes={"train": 4}, workers=0, progress=False)
    card = DatasetCard.read(folder)
    mirror = Symmetry((1, -2), mirrored=True, states={"position": (1, -2)})
    replace(card, environment=replace(card.environment, symmetries=(mirror,))).write(folder)
    return folder


def test_clips_hold_the_states_of_their_frames(mirrored):
    episodes = EpisodeDataset(mirrored, "train")
    symmetries = episodes.card.environment.symmetries
    windows = {"frames": 9, "stride": 2, "symmetries": symmetries}
    clips = ClipDataset(episodes, **windows, states=["position", "position"])
    for index, (episode, start) in enumerate(clips.windows.tolist()):
        true = episodes[episode].states["position"][start : start + 9]
        true = true * [1, -1] if clips.version(index) else true
        found = clips[index]["states"].numpy()
        np.testing.assert_allclose(found, np.concatenate([true, true], 1), rtol=1e-6)


def test_the_scale_is_that_of_the_training_episodes(data):
    episodes = EpisodeDataset(data, "train")
    config = DataConfig(str(data), validation_episodes=2, states=("position",))
    mean, std = ClipData(config, episodes, TinyCodec(), 0).state_scale()
    rows = np.concatenate([episodes[index].states["position"] for index in range(6)])
    np.testing.assert_allclose(mean, rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(std, rows.std(0), rtol=1e-5)


def test_what_moves_by_rounding_alone_is_not_magnified(data, monkeypatch):
    """The base of an arm, among its links: solvers leave some nanometres."""
    episodes = EpisodeDataset(data, "train")
    read = EpisodeDataset.states

    def shaken(self, index, names):
        rows = read(self, index, names).copy()
        rows[:, 1] = 1e-9 * np.sin(np.arange(len(rows)))
        return rows

    monkeypatch.setattr(EpisodeDataset, "states", shaken)
    config = DataConfig(str(data), states=("position",))
    _, std = ClipData(config, episodes, TinyCodec(), 0).state_scale()
    assert std[1] == 1
    assert std[0] > 2


def test_a_killed_run_resumes_with_the_same_states(data, tmp_path, monkeypatch):
    asked = {**LEARNER, "data": PLACES, "training": {"agent_steps": 3}}
    whole = RunFolder(fit(killable(data, **asked), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 7)
    run = killed_run(data, tmp_path / "run", monkeypatch, **asked)
    fit(killable(data, **asked), tmp_path / "unused", resume=run.path)
    assert_same(whole, run)
    plain = torch.load(
        RunFolder(fit(killable(data, **LEARNER), tmp_path / "plain")).last_checkpoint,
        weights_only=True,
    )["state_dict"]
    assert not [name for name in plain if "agent" in name]


def test_the_motion_is_learnt_first_and_then_kept(data, tmp_path):
    """Positions go on by the actions: a second of steps without pictures finds out how."""

    def trained(name, steps, pictures=2, **sections):
        asked = {**LEARNER, "data": PLACES, "training": {"agent_steps": steps}, **sections}
        asked["trainer"] = {"max_steps": pictures}
        return RunFolder(fit(tiny_recipe(data, **asked), tmp_path / name))

    def weights(run):
        held = load_file(run.weights)
        return {k: v for k, v in held.items() if "agent.gru" in k or "embedder.mlp" in k}

    config = DataConfig(str(data), validation_episodes=2, states=tuple(PLACES["states"]))
    episodes = EpisodeDataset(data, "train")
    clips = ClipDataset(episodes, indices=range(6), frames=9, temporal_stride=2, **PLACES)
    scale = ClipData(config, episodes, TinyCodec(), 0).state_scale()

    @torch.no_grad()
    def error(run):
        world = acwm.load(run.path).world_model
        world.state_mean, world.state_std = scale
        held = clips.inputs(range(len(clips)))
        return world.motion_loss(**held, random=torch.Generator().manual_seed(0), progress=1).item()

    before, after = trained("before", 0), trained("after", 300)
    assert error(after) < 0.1 * error(before)
    longer = trained("longer", 300, pictures=5)
    assert weights(after).keys() == weights(longer).keys() != set()
    for name, value in weights(after).items():
        torch.testing.assert_close(value, weights(longer)[name], rtol=0, atol=0)


def test_what_cannot_be_learnt_is_refused(data, mirrored, tmp_path):
    def refused(error: type[AcwmError], said: str, folder=data, **sections):
        with pytest.raises(error, match=said):
            fit(tiny_recipe(folder, **{**LEARNER, "data": PLACES, **sections}), tmp_path / "run")
        assert not (tmp_path / "run").exists()

    refused(RecipeError, "has no state 'angle', but position", data={"states": ["angle"]})
    refused(RecipeError, "learns no states", objective={}, model={})
    refused(RecipeError, "name them", data={}, training={"agent_steps": 3})
    refused(RecipeError, "random_access", data={**PLACES, "reader": "webdataset"})
    card = DatasetCard.read(mirrored)
    silent = Symmetry((1, -2), mirrored=True)
    replace(card, environment=replace(card.environment, symmetries=(silent,))).write(mirrored)
    both = {**PLACES, "symmetries": True}
    refused(DataError, "does not say how it transforms position", folder=mirrored, data=both)
