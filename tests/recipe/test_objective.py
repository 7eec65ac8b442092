"""The objective of a recipe: named by a word, by its model, or in an older recipe."""

import pytest
import yaml

from acwm_core.errors import RecipeError
from acwm_core.recipe import Recipe, compose

SMALL = {"shift": 20.0, "prediction": "clean", "loss_on": "clean", "weighting": "none", "steps": 4}
PAST = {"past_noise": 0.3, "own_past": 0.0}


def objective(*words, recipe="push_cube_small"):
    found = compose(recipe, words).objective
    return found.name, found.params


def test_a_new_objective_keeps_the_noise_path_and_drops_the_rest():
    assert objective() == ("diffusion_forcing", SMALL)
    assert objective("objective=next_frame", "objective.own_past=0.5") == (
        "next_frame",
        {**SMALL, "past_noise": 0.3, "own_past": 0.5},
    )
    assert objective("+next_frame", "objective=full_sequence") == ("full_sequence", SMALL)
    assert objective("+shortcut", "+next_frame")[1].items() >= SMALL.items()
    assert objective("+recurrent", "objective=diffusion_forcing")[1] == SMALL
    with pytest.raises(RecipeError, match="FullSequence has no parameter 'own_past'"):
        objective("objective=full_sequence", "objective.own_past=0.5")


def test_a_model_with_an_objective_of_its_own_brings_it():
    for words in (
        ["model=recurrent"],
        ["+recurrent"],
        ["+next_frame", "+recurrent"],
        ["+recurrent", "+small"],  # which replaces the objective of the paper alone
    ):
        assert objective(*words) == ("regression", {"frames": None})
    scene = {"state_weight": 0.3, "frames": None, "motion_steps": 0, "point_steps": 1000}
    assert objective("model=scene") == ("scene", scene)
    assert objective("+next_frame", "+scene") == (
        "scene",
        {**scene, "frames": 4, "motion_steps": 8000},
    )
    for words in (["+recurrent", "model=dit_xs"], ["+scene", "model=dit_xs"]):
        assert objective(*words) == ("diffusion_forcing", SMALL)
    assert objective("+scene", "model=recurrent") == ("regression", {"frames": None})


def test_parameters_given_with_the_model_are_those_of_its_own_objective(tmp_path):
    wanted = ("regression", {"frames": 4})
    for words in (
        ["model=recurrent", "objective.frames=4"],
        ["objective.frames=4", "+recurrent"],
        ["+recurrent", "+small", "objective.frames=4"],
    ):
        assert objective(*words) == wanted
    mine = tmp_path / "mine.yaml"
    for first in ("extends: push_cube_small\nmodel: recurrent\n", "extends: small\n"):
        mine.write_text(f"{first}objective: {{frames: 4}}\n")
        assert objective(recipe=mine) == wanted
        assert objective("objective.frames=2", recipe=mine)[1]["frames"] == 2
        assert objective("model=dit_xs", recipe=mine)[0] == "diffusion_forcing"
    for name in ("frams", "shift"):
        with pytest.raises(RecipeError, match=f"Regression has no parameter '{name}'"):
            objective("+recurrent", f"objective.{name}=4")


def test_an_objective_chosen_with_the_model_or_later_stays(tmp_path):
    assert objective("+recurrent", "objective=next_frame")[0] == "next_frame"
    mine = tmp_path / "mine.yaml"
    mine.write_text("extends: push_cube_small\nmodel: recurrent\nobjective: next_frame\n")
    assert objective(recipe=mine)[0] == "next_frame"
    mine.write_text("extends: push_cube_small\nmodel: recurrent\n")
    assert objective(recipe=mine) == ("regression", {"frames": None})
    assert objective("+next_frame", recipe=mine)[0] == "next_frame"  # refused with this model
    assert objective("objective=regression", "objective.frames=2", recipe=mine)[1]["frames"] == 2


def test_a_saved_recipe_says_what_was_used(tmp_path):
    saved = tmp_path / "saved.yaml"
    for words in (["model=recurrent"], ["+next_frame"], ["objective.shift=7"]):
        recipe = compose("push_cube_small", words)
        saved.write_text(recipe.to_yaml())
        assert compose(saved) == recipe


def test_a_recipe_that_names_none_is_one_level_per_clip():
    parts = {"codec": "compact", "model": "dit_xs", "conditioner": "adaln"}
    sections = {name: {"name": part} for name, part in parts.items()}
    recipe = Recipe.from_dict({**sections, "data": {"path": "data"}})
    assert recipe.objective.name == "full_sequence"
    sections["model"] = {"name": "recurrent"}
    recipe = Recipe.from_dict({**sections, "data": {"path": "data"}})
    assert recipe.objective.name == "regression"


def test_an_older_file_whose_objective_follows_the_model_is_read(tmp_path):
    mine = tmp_path / "mine.yaml"
    follows = "objective: {name: next_frame, follows_model: true, own_past: 0.5}\n"
    for first in ("extends: push_cube_small\nmodel: recurrent\n", "extends: small\n"):
        mine.write_text(first + follows)
        assert objective(recipe=mine) == ("regression", {"frames": None})
    mine.write_text("extends: push_cube_small\n" + follows)
    assert objective(recipe=mine)[1] == {**SMALL, "past_noise": 0.3, "own_past": 0.5}
    assert objective("+recurrent", recipe=mine)[0] == "regression"


@pytest.mark.parametrize(
    "words", [[], ["+next_frame"], ["+recurrent"], ["+next_frame", "+recurrent"]]
)
def test_a_recipe_of_an_older_run_is_read(tmp_path, words):
    """As acwm wrote it before objectives were components: every model had all parameters."""
    recipe = compose("push_cube_small", words)
    old = recipe.to_dict()
    del old["objective"]
    name = "next_frame" if "+next_frame" in words else "diffusion_forcing"
    old["flow"] = {"objective": name, **SMALL, **PAST}
    if "inputs" in old["model"]:
        del old["model"]["inputs"]
        old["model"]["previous"] = None
    old["data"]["skip_damaged"] = False
    old["evaluation"]["floor_episodes"] = old["evaluation"].pop("noise_floor_episodes")
    saved = tmp_path / "recipe.yaml"
    saved.write_text(yaml.safe_dump(old))
    assert compose(saved) == recipe
