"""The example entries: plain programs, which import nothing of acwm, and whose videos are taken."""

import ast
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from acwm_benchmark.export import export_tasks
from acwm_benchmark.score import score_predictions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate

ENTRIES = Path(__file__).parents[2] / "examples" / "entries"
QUICK = {"nearest": [], "simvp": ["--steps=1"], "edm_unet": ["--steps=1", "--channels=8"]}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder with a dataset of four training episodes and two to test on, and its tasks."""
    home = tmp_path_factory.mktemp("world")
    episodes = {"train": 4, "ind_test": 2}
    generate("slide", home / "data/slide", episodes=episodes, workers=0, progress=False)
    few = ["evaluation.frames=9", "evaluation.counterfactual_episodes=1"]
    export_tasks(["slide"], home / "tasks", data=home / "data", overrides=few)
    return home


@pytest.mark.parametrize("name", QUICK)
def test_an_entry_imports_nothing_of_acwm(name):
    tree = ast.parse((ENTRIES / f"{name}.py").read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    modules = {node.module or "" for node in imports if isinstance(node, ast.ImportFrom)}
    modules |= {
        name.name for node in imports if isinstance(node, ast.Import) for name in node.names
    }
    assert not [module for module in modules if module.startswith("acwm")]


@pytest.mark.ci
@pytest.mark.parametrize("name", QUICK)
def test_the_videos_of_an_entry_are_scored(world, name, monkeypatch):
    out = world / name
    paths = ["--data", world / "data/slide", "--tasks", world / "tasks", "--out", out]
    monkeypatch.setattr(sys, "argv", [name, *map(str, paths), *QUICK[name]])
    runpy.run_path(str(ENTRIES / f"{name}.py"), run_name="__main__")
    places = {"tasks": world / "tasks", "data": world / "data", "out": world / "scores" / name}
    assert score_predictions(out, **places, progress=False).keys() == {"slide"}


def test_the_nearest_neighbour_of_a_training_episode_is_itself(world):
    module = runpy.run_path(str(ENTRIES / "nearest.py"))
    neighbours = module["Neighbours"](world / "data/slide", looks=1.0)
    for episode in EpisodeDataset(world / "data/slide", "train"):
        predicted = neighbours.predict(episode.video[:1], episode.actions)
        np.testing.assert_array_equal(predicted, episode.video)


def test_edm_keeps_a_frame_without_noise_and_ignores_one_of_noise_alone(world):
    """The limits of the preconditioning (Karras et al. 2022, table 1), with offset noise."""
    module = runpy.run_path(str(ENTRIES / "edm_unet.py"))
    entry = module["Entry"]([*module["training_episodes"](world / "data/slide")], 8, seed=0)
    torch = module["torch"]
    torch.nn.init.zeros_(entry.network.head.bias)  # as its weight is, before training
    noisy, past = torch.rand(1, 3, 16, 16), torch.zeros(1, 12, 16, 16)
    actions = torch.zeros(1, entry.network.actions.in_features)
    for sigma, share in ((1e4, 0.0), (0.0, 0.25 / (0.25 + 0.09))):
        kept = entry.denoised(noisy, torch.tensor([sigma]), past, actions)
        torch.testing.assert_close(kept, share * noisy, atol=1e-4, rtol=1e-4)
