import pytest
import torch

from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from tests import tiny
from tests.evaluation.test_given_frames import QUICK


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    torch.set_num_threads(1)
    tiny.register()
    return tiny.make_dataset(tmp_path_factory.mktemp("data") / "drift", train=6)


@pytest.fixture(scope="session")
def run(data, tmp_path_factory):
    """A run that was trained for some steps; tests must not change it."""
    recipe = {
        "env": {"name": "drift"},
        "codec": {"name": "blocks"},
        "model": {"name": "linear"},
        "conditioner": {"name": "linear"},
        "objective": {"steps": 2, "prediction": "clean"},
        "data": {"path": str(data), "clip_frames": 9, "batch_size": 2, "validation_episodes": 2},
        "evaluation": {**tiny.METRICS, **QUICK, "metrics": ["mse", "psnr"], "device": "cpu"},
        "training": {"validate_every_n_steps": 2, "learning_rate": 1e-3},
        "trainer": {"max_steps": 6, "accelerator": "cpu"},
    }
    recipe["evaluation"]["steps_sweep"] = []
    return fit(Recipe.from_dict(recipe), tmp_path_factory.mktemp("runs") / "trained")
