"""Training on states: which clips hold them, that it resumes, and what is refused."""

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
SCENE = {"name": "scene", "channels": 4, "width": 8, "blocks": 1}


def learner(steps=0, **sections):
    """Sections of a recipe whose model learns for some steps how things move."""
    objective = {"name": "scene", "motion_steps": steps}
    return {"model": SCENE, "objective": objective, "data": PLACES, **sections}


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


@pytest.mark.parametrize("steps", [0, 3])
@pytest.mark.ci
def test_a_killed_run_resumes_with_the_same_states(steps, data, tmp_path, monkeypatch):
    asked = learner(steps)
    whole = RunFolder(fit(killable(data, **asked), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 7)
    run = killed_run(data, tmp_path / "run", monkeypatch, **asked)
    fit(killable(data, **asked), tmp_path / "unused", resume=run.path)
    assert_same(whole, run)


@pytest.mark.ci
def test_a_killed_run_resumes_with_the_same_points(data, tmp_path, monkeypatch):
    """Points and their motion were learnt before the first picture, and are not learnt again."""
    objective = {"name": "scene", "point_steps": 3, "motion_steps": 3}
    asked = {"model": {**SCENE, "points": 2}, "objective": objective}
    whole = RunFolder(fit(killable(data, **asked), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 7)
    run = killed_run(data, tmp_path / "run", monkeypatch, **asked)
    monkeypatch.setattr("acwm_scene.point_training.pair_loss", None)
    fit(killable(data, **asked), tmp_path / "unused", resume=run.path)
    assert_same(whole, run)


@pytest.mark.ci
def test_the_scale_of_growing_data_is_that_of_the_start(data, tmp_path, monkeypatch):
    """A run that was killed goes on with the scale that it began with, whatever data came since."""
    grown = {"data": {**PLACES, "growing": True, "validation_episodes": 2}}
    asked = learner(**grown)
    whole = RunFolder(fit(killable(data, **asked), tmp_path / "whole"))
    monkeypatch.setattr(Kill, "batch", 7)
    run = killed_run(data, tmp_path / "run", monkeypatch, **asked)
    other = torch.full((2,), 5.0), torch.full((2,), 9.0)
    monkeypatch.setattr(ClipData, "state_scale", lambda self: other)
    fit(killable(data, **asked), tmp_path / "unused", resume=run.path)
    assert_same(whole, run)


def test_weights_keep_what_their_numbers_mean_on_other_data(data, tmp_path, monkeypatch):
    """`training.init_from` on data of another scale changes no state that is predicted."""
    first = fit(tiny_recipe(data, **learner(5, trainer={"max_steps": 2})), tmp_path / "first")
    scale = load_file(RunFolder(first).weights)["model.groups.values.mean"]
    assert scale.abs().min() > 0
    monkeypatch.setattr(ClipData, "state_scale", lambda self: (scale + 9, scale / scale))
    asked = learner(5, training={"init_from": str(first)}, trainer={"max_steps": 2})
    second = fit(tiny_recipe(data, **asked), tmp_path / "second")
    kept = load_file(RunFolder(second).weights)["model.groups.values.mean"]
    torch.testing.assert_close(kept, scale)


@pytest.mark.ci
def test_the_motion_is_learnt_first_and_then_kept(data, tmp_path):
    """Positions go on by the actions: a second of steps without pictures finds out how."""

    def trained(name, steps, pictures=2):
        asked = learner(steps, trainer={"max_steps": pictures})
        return RunFolder(fit(tiny_recipe(data, **asked), tmp_path / name))

    def weights(run):
        held = load_file(run.weights)
        return {k: v for k, v in held.items() if "motion.gru" in k or "embedder.mlp" in k}

    episodes = EpisodeDataset(data, "train")
    clips = ClipDataset(episodes, indices=range(6), frames=9, temporal_stride=2, **PLACES)

    @torch.no_grad()
    def error(run):
        world = acwm.load(run.path).world_model
        held = clips.inputs(range(len(clips)))
        random = torch.Generator().manual_seed(0)
        conditioning = world.condition(held["actions"], 5)
        return world.model.motion_loss(held["states"], conditioning, random, progress=1).item()

    before, after = trained("before", 1), trained("after", 300)
    assert error(after) < 0.1 * error(before)
    longer = trained("longer", 300, pictures=5)
    assert weights(after).keys() == weights(longer).keys() != set()
    for name, value in weights(after).items():
        torch.testing.assert_close(value, weights(longer)[name], rtol=0, atol=0)


def test_predicted_states_are_those_of_the_card(data, tmp_path):
    """By name, of every video frame after the given one, in pixels of the tiny world."""
    run = fit(tiny_recipe(data, **learner(1, trainer={"max_steps": 2})), tmp_path / "run")
    world = acwm.load(run).world_model
    episode = EpisodeDataset(data, "train")[0]
    first = torch.from_numpy(episode.video[0].copy()).permute(2, 0, 1)[None] / 255
    states = world.predict_states(first, torch.from_numpy(episode.actions[None, :9]))
    assert states["position"].shape == (1, 8, *episode.states["position"].shape[1:])


def test_what_cannot_be_learnt_is_refused(data, mirrored, tmp_path):
    def refused(error: type[AcwmError], said: str, folder=data, **sections):
        with pytest.raises(error, match=said):
            fit(tiny_recipe(folder, **learner(**sections)), tmp_path / "run")
        assert not (tmp_path / "run").exists()

    refused(RecipeError, "has no state 'angle', but position", data={"states": ["angle"]})
    refused(RecipeError, "learns no states", objective={}, model={})
    refused(RecipeError, "random_access", data={**PLACES, "reader": "webdataset"})
    card = DatasetCard.read(mirrored)
    silent = Symmetry((1, -2), mirrored=True)
    replace(card, environment=replace(card.environment, symmetries=(silent,))).write(mirrored)
    both = {**PLACES, "symmetries": True}
    refused(DataError, "transforms position: leave out", folder=mirrored, data=both)
