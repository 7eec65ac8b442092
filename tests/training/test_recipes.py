"""Whatever shipped recipes train, at small scale, and swaps of parts, take two real steps."""

import csv
import math

import numpy as np
import pytest

from acwm_core.data.generate import generate
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.compose import recipe_names
from acwm_core.training.fit import fit
from acwm_formats.arrays import Recording, write_dataset

SMALL = ("small", "push_cube_small")
"""Recipes that are small as they are."""

TRIED = (
    "robot_arm",
    "robot_arm_cross_attention",
    "robot_arm_dit_m",
    "cloth_move_dit_l",
    "pour_water_flux",
    "demo",
)
"""One recipe for each choice of parts; all others differ from one of them in their data alone."""

LARGE = ("dit_m", "dit_l")
"""Models of over half a billion parameters, which differ from smaller ones in size alone."""

SWAPPED = (
    ("push_cube_small", ("conditioner=cross_attention",)),
    ("push_cube_small", ("codec=identity",)),
    ("push_cube_small", ("objective=diffusion_forcing",)),
    ("robot_arm", ("+small", "+scene")),
    ("push_rope", ("+small", "+scene")),
    ("small", ("+points",)),
    ("cloth_move", ("+small", "+scene", "data.symmetries=true")),
    ("push_cube", ("+small", "+next_frame", "objective.own_past=0.5")),
)
"""Recipes, and words that swap parts of them or ask for more."""

SMALL_STEPS = (
    "trainer.max_steps=2",
    "trainer.accelerator=cpu",
    "trainer.log_every_n_steps=1",
    "trainer.enable_progress_bar=false",
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
    """A function from the name of an environment to data with its name and its actions.

    Recordings have no states; where a recipe learns from them, the environment is simulated.
    """
    folder = tmp_path_factory.mktemp("recipes")

    def made(environment, states=False):
        out = folder / f"{environment}{'_with_states' * states}"
        if not out.exists() and states:
            episodes = {"train": 3}
            generate(environment, out, episodes=episodes, size=64, workers=0, progress=False)
        elif not out.exists():
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
        *(
            pytest.param(name, ("+small",), marks=[] if name == "robot_arm" else pytest.mark.ci)
            for name in TRIED
        ),
        ("push_cube", ("+small", "+recurrent")),
        *(pytest.param(*swapped, marks=pytest.mark.ci) for swapped in SWAPPED),
    ],
)
def test_two_real_steps(recipe, words, data_of, tmp_path):
    chosen = compose(recipe, words)
    world = chosen.env.name if chosen.env else "push_cube"
    states = chosen.model.name == "scene" and "+points" not in words
    motion = ("objective.motion_steps=2", "objective.point_steps=2") * (
        chosen.model.name == "scene"
    )
    fewer = ("model.layers=2",) * (chosen.model.name in LARGE)
    takes_two_steps(recipe, (*words, *motion, *fewer), data_of(world, states), tmp_path)


@pytest.mark.ci
def test_every_recipe_trains_parts_that_are_tried():
    def parts(name):
        composed = compose(name, () if name in SMALL else ("+small",)).to_dict()
        sections = ("codec", "model", "conditioner", "objective", "training")
        return {section: composed[section] for section in sections}

    tried = {name: parts(name) for name in (*SMALL, *TRIED)}
    untried = [name for name in recipe_names() if parts(name) not in tried.values()]
    assert untried == []


@pytest.mark.ci
def test_a_scene_learns_what_its_card_declares(data_of, tmp_path):
    words = ("+small", "+scene", "codec=compact_reference", "objective.motion_steps=2")
    run = takes_two_steps("push_cube", words, data_of("push_cube", True), tmp_path)
    states = ["pusher_position", "cube_present", "cube_position", "cube_yaw"]
    assert [*Recipe.from_yaml(run / "recipe.yaml").data["states"]] == states


def takes_two_steps(recipe, words, data, tmp_path):
    chosen = compose(recipe, [*words, f"data.path={data}", *SMALL_STEPS])
    run = fit(chosen, tmp_path / "run")
    rows = [row for row in csv.DictReader((run / "metrics.csv").open()) if row["train/loss"]]
    assert [row["step"] for row in rows] == ["0", "1"]
    assert all(math.isfinite(float(row["train/loss"])) for row in rows)
    return run
