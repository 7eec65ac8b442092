"""Every shipped recipe, at small scale, and the swaps the README promises, take two real steps."""

import csv
import math

import numpy as np
import pytest

from acwm_core.data.generate import generate
from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from acwm_core.recipe.compose import recipe_names
from acwm_core.training.fit import fit
from acwm_formats.arrays import Recording, write_dataset

SMALL = ("small", "push_cube_small")
"""Recipes that are small as they are."""

SMALL_STEPS = (
    "trainer.max_steps=2",
    "trainer.accelerator=cpu",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
    "trainer.enable_checkpointing=false",
    "training.cpu_threads=1",
    "training.sample_every_n_steps=0",
    "data.batch_size=2",
    "data.clip_frames=5",
    "data.validation_episodes=1",
)


def recordings(action, episodes):
    """A bright square that wanders over grey, under random actions within bounds."""
    rng = np.random.default_rng(0)
    for _ in range(episodes):
        video = np.full((6, 32, 32, 3), 90, np.uint8)
        for frame, place in enumerate(rng.integers(0, 24, (6, 2))):
            video[frame, place[0] : place[0] + 8, place[1] : place[1] + 8] = 230
        yield Recording(video, rng.uniform(action.low, action.high, (6, action.size)))


@pytest.fixture(scope="module")
def data_of(tmp_path_factory):
    """A function from the name of an environment to data with its name and its actions."""
    folder = tmp_path_factory.mktemp("recipes")

    def made(environment):
        out = folder / environment
        if not out.exists():
            card = catalog().component("environment", environment).load().card
            episodes = {"train": list(recordings(card.action, 5))}
            given = {"name": environment, "action": card.action, "fps": card.fps}
            write_dataset(out, episodes, **given, progress=False)
        return out

    return made


@pytest.mark.parametrize(
    ("recipe", "words"),
    [
        *((name, ()) for name in SMALL),
        ("robot_arm", ("+small",)),
        *(
            pytest.param(name, ("+small",), marks=pytest.mark.ci)
            for name in recipe_names()
            if name not in (*SMALL, "robot_arm")
        ),
        ("push_cube_small", ("conditioner=cross_attention",)),
        ("push_cube_small", ("codec=identity",)),
        ("push_cube_small", ("objective=diffusion_forcing",)),
        ("push_cube", ("+small", "+recurrent")),
        ("push_cube", ("+small", "+next_frame", "objective.own_past=0.5")),
    ],
)
def test_two_real_steps(recipe, words, data_of, tmp_path):
    environment = compose(recipe, words).env
    data = data_of(environment.name if environment else "push_cube")
    takes_two_steps(recipe, words, data, tmp_path)


@pytest.mark.parametrize(
    ("world", "model"), [("push_cube", "planar_bodies"), ("robot_arm", "drawn_states")]
)
def test_two_real_steps_on_states(world, model, tmp_path):
    """The recordings have no states, so these are simulated."""
    data = tmp_path / "data"
    generate(world, data, episodes={"train": 3}, size=(64, 64), workers=0, progress=False)
    words = ("+small", "+recurrent", f"+{model}", "training.agent_steps=2")
    takes_two_steps(world, words, data, tmp_path)
    with pytest.raises(RecipeError, match=f"model={model} learns from states: name them"):
        takes_two_steps(
            world,
            (*words, "data.states=[]", "training.agent_steps=0"),
            data,
            tmp_path / "other",
        )


def takes_two_steps(recipe, words, data, tmp_path):
    chosen = compose(recipe, [*words, f"data.path={data}", *SMALL_STEPS])
    run = fit(chosen, tmp_path / "run")
    rows = [row for row in csv.DictReader((run / "metrics.csv").open()) if row["train/loss"]]
    assert [row["step"] for row in rows] == ["0", "1"]
    assert all(math.isfinite(float(row["train/loss"])) for row in rows)
