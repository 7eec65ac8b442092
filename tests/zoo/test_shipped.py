"""The models that ship: their sizes, their facts, and that each predicts what it was scored for."""

import math

import pytest
import torch

import acwm
from acwm_core.data.card import DatasetCard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.errors import MissingExtraError
from acwm_core.evaluation.results import Summary
from acwm_core.model.build import build_world_model
from acwm_core.plugins import Registry
from acwm_core.recipe.recipe import compose
from acwm_core.training.run import load_weights, read_metadata
from acwm_core.training.run_folder import RunFolder
from acwm_zoo.packing import FILES, MAX_BYTES
from acwm_zoo.plugin import register_trained_models
from acwm_zoo.shipped import about, folder, shipped

ALL_BYTES = 90_000_000
pytestmark = pytest.mark.ci


def test_they_are_small_and_hold_nothing_else():
    sizes = {}
    weights = []
    for name in shipped():
        files = [path for path in folder(name).rglob("*") if path.is_file()]
        allowed = {path for pattern in FILES for path in folder(name).glob(pattern)}
        assert set(files) == allowed
        sizes[name] = sum(path.stat().st_size for path in files)
        weights.append(RunFolder(folder(name)).weights.stat().st_size)
    assert max(weights) <= MAX_BYTES
    assert sum(sizes.values()) <= ALL_BYTES


def test_a_model_whose_files_are_not_installed_names_the_package(tmp_path, monkeypatch):
    """As in acwm's own wheel, which has the cards of all models and the files of one."""
    (tmp_path / "reacher").mkdir()
    (tmp_path / "reacher/README.md").write_text("# A model\n")
    monkeypatch.setattr("acwm_zoo.shipped.MODELS", tmp_path)
    registry = Registry("trained_model")
    register_trained_models(registry)
    assert shipped() == []
    assert "pip install acwm-models" in registry["reacher"].needs
    with pytest.raises(MissingExtraError, match="pip install acwm-models"):
        registry["reacher"].create()


@pytest.mark.parametrize("name", shipped())
def test_it_says_how_it_was_made_and_how_good_it_is(name):
    facts, summary = read_metadata(RunFolder(folder(name)).weights), Summary.read(folder(name))
    assert facts["cpu_seconds"] > 0
    assert summary.provenance["training_steps"] == facts["step"]
    least = 16 if name == "push_cube_128" else 64  # large frames take long
    scored = {split: each.scores.episodes for split, each in summary.splits.items()}
    assert scored == {"ind_test": least, "ood_test": least}
    assert about(name)


def test_a_training_can_go_on_from_it_as_the_docs_say():
    recipe = compose("push_sand", ["+small", "+recurrent", "model.channels=96"])
    card = DatasetCard.read(RunFolder(folder("push_sand")).card)
    world_model = build_world_model(recipe, card.environment)
    load_weights(world_model, RunFolder(folder("push_sand")).weights)
    theirs = acwm.load("push_sand").world_model.model.state_dict()
    own = world_model.model.state_dict()
    assert own.keys() == theirs.keys()
    assert all(torch.equal(value, theirs[name]) for name, value in own.items())


@pytest.mark.parametrize("name", shipped())
def test_it_predicts_an_episode_better_than_one_that_stands_still(name):
    """On an episode that is simulated anew, so with no data at all."""
    card = DatasetCard.read(RunFolder(folder(name)).card)
    if name == "pour_water":
        pytest.skip("an episode takes seconds")
    environment = make_environment(card.environment.name, card.options)
    episode = simulate(environment, card.spec("ind_test", 0))
    environment.close()
    truth = torch.from_numpy(episode.video).permute(0, 3, 1, 2).float() / 255
    _, _, world_model = acwm.load(name)
    actions = torch.from_numpy(episode.actions)[None]
    predicted = world_model.rollout(truth[:1], actions, check=False)[0]
    error, still = ((truth - each).square().mean() for each in (predicted, truth[:1]))
    assert 10 * math.log10(still / error) > 1  # dB
