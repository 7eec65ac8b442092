"""Shipped recipes: each of the paper's experiments beside what it is compared with."""

import functools

import pytest

from acwm_core import recipe as recipes
from acwm_core.recipe.compose import recipe_folder, recipe_names


@functools.cache
def compose(name, words=()):
    return recipes.compose(name, words)


ENVIRONMENTS = (
    "push_cube",
    "stack_cube",
    "push_rope",
    "cloth_move",
    "push_sand",
    "pour_water",
    "robot_arm",
    "reacher",
)

COMPARED = {
    **{
        f"{env}_dit_{size}": (env, {"model"})
        for env in ("cloth_move", "robot_arm")
        for size in "ml"
    },
    **{
        f"{env}_cross_attention": (env, {"conditioner"})
        for env in ("push_cube", "push_rope", "robot_arm", "cloth_move_8d")
    },
    **{f"{env}_flux": (env, {"codec"}) for env in ("pour_water", "robot_arm")},
    **{
        f"{env}_{part}": (env, {"data"})
        for env in ("push_cube", "pour_water")
        for part in ("half", "quarter")
    },
    "cloth_move_8d": ("cloth_move", {"env", "data"}),
    "push_cube_two_pushers": ("push_cube", {"env", "data"}),
}
"""Each ablation of the paper with the recipe beside it and the sections that differ."""

PAPER = (*ENVIRONMENTS, *COMPARED)


def differing(one, other):
    one, other = one.to_dict(), other.to_dict()
    return {section for section in {*one, *other} if one.get(section) != other.get(section)}


def test_these_are_all_of_them():
    assert set(recipe_names()) == {*PAPER, "demo", "small", "push_cube_small"}


@pytest.mark.parametrize("name", PAPER)
def test_the_papers_experiments_share_its_setting(name):
    recipe = compose(name)
    assert recipe.objective.name == "full_sequence"
    assert recipe.objective.params == {
        **{"prediction": "velocity", "loss_on": "velocity"},
        **{"shift": 5.0, "weighting": "gaussian", "steps": 49},
    }
    assert recipe.training["learning_rate"] == 1e-4
    assert (recipe.training["schedule"], recipe.training["ema_decay"]) == ("constant", 0.0)
    assert (recipe.data["batch_size"], recipe.data["clip_frames"]) == (4, 37)
    assert recipe.conditioner.params["embedding"] == "convolutional"
    wanted = {"max_steps": 100_000, "devices": 8, "gradient_clip_val": 1.0}
    assert wanted.items() <= recipe.trainer.items()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_main_results_are_of_dit_s_with_adaln_and_wan(name):
    recipe = compose(name)
    chosen = [part.name for part in (recipe.env, recipe.model, recipe.codec, recipe.conditioner)]
    assert chosen == [name, "dit_s", "wan", "adaln"]


@pytest.mark.parametrize("words", [(), ("+small",)], ids=["published", "small"])
@pytest.mark.parametrize("name", COMPARED)
def test_ablations_differ_in_what_they_compare_alone(name, words):
    beside, sections = COMPARED[name]
    assert differing(compose(name, words), compose(beside, words)) == sections


@pytest.mark.parametrize("name", PAPER)
def test_small_twins_need_no_download_and_one_device(name):
    twin = compose(name, ("+small",))
    assert twin.codec.name.startswith("compact")
    assert twin.model.name == "dit_xs"
    assert (twin.trainer["devices"], twin.trainer["max_steps"]) == (1, 1700)
    assert twin.data["path"] == f"{compose(name).data['path']}_small"
    assert twin.env == compose(name).env


def test_twins_of_larger_models_are_larger():
    sizes = [
        compose(name, ("+small",)).model.params
        for name in ("robot_arm", "robot_arm_dit_m", "robot_arm_dit_l")
    ]
    weights = [size["width"] ** 2 * size["layers"] for size in sizes]
    assert weights == sorted(set(weights))


def test_fractions_are_those_of_the_paper():
    fractions = {name: compose(name).data["fraction"] for name in COMPARED if "water" in name}
    assert fractions == {"pour_water_flux": 1.0, "pour_water_half": 0.5, "pour_water_quarter": 0.25}


def test_the_small_push_cube_is_the_twin():
    assert compose("push_cube_small") == compose("push_cube", ("+small",))
    assert compose("push_cube", ("+small",)) == compose("push_cube", ("+small", "+small"))


def test_the_recipe_for_own_data_trains_as_the_recurrent_overlay():
    own, twin = compose("small"), compose("push_cube", ("+small", "+recurrent"))
    assert own.model.name == "recurrent"
    assert differing(own, twin) == {"env", "data", "trainer"}
    assert own.trainer == {**twin.trainer, "max_steps": 3000}
    assert own.data == {**twin.data, "path": own.data["path"]}


@pytest.mark.parametrize("folder", ["env", "model", "codec", "conditioner"])
def test_every_part_composes_by_its_name(folder):
    for path in (recipe_folder() / folder).glob("*.yaml"):
        composed = compose("push_cube", (f"{folder}={path.stem}",))
        assert getattr(composed, folder).name == path.stem
        assert path.read_text().count(path.stem)
