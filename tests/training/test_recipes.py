"""Every shipped recipe, and the swaps the README promises, take two real steps on real data."""

import csv
import math

import pytest

from acwm_core.data.generate import generate
from acwm_core.recipe import compose
from acwm_core.recipe.compose import recipe_names
from acwm_core.training.launch import fit

SMALL_STEPS = (
    "trainer.max_steps=2",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "trainer.enable_checkpointing=false",  # those of dit_s are gigabytes
    "training.cpu_threads=1",
    "training.sample_every_n_steps=0",
    "data.batch_size=2",
    "data.clip_frames=5",
    "data.window_stride=32",
    "data.validation_episodes=1",
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recipes") / "data"
    episodes = {"train": 3, "ind_test": 1, "ood_test": 1}
    generate("push_cube", folder, episodes=episodes, size=64, workers=0, progress=False)
    return folder


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        *((name, ()) for name in recipe_names()),
        ("push_cube_small", ("conditioner=cross_attention",)),
        ("push_cube_small", ("codec=identity",)),
    ],
)
def test_two_real_steps(recipe, words, dataset, tmp_path):
    chosen = compose(recipe, [f"data.path={dataset}", *SMALL_STEPS, *words])
    run = fit(chosen, tmp_path / "run")
    rows = [row for row in csv.DictReader((run / "metrics.csv").open()) if row["train/loss"]]
    assert [row["step"] for row in rows] == ["0", "1"]
    assert all(math.isfinite(float(row["train/loss"])) for row in rows)
