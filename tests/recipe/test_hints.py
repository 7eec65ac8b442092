"""What is said of names that nothing has: the nearest, the section, plugins that were left out."""

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import RecipeError
from acwm_core.plugins import Catalog, Problem
from acwm_core.recipe import compose, recipe_names
from tests.plugins import plugin_of


@pytest.mark.parametrize(
    ("override", "wanted"),
    [
        ("seed=3", "training.seed"),
        ("max_steps=9", "trainer.max_steps"),
        ("batch_size=2", "data.batch_size"),
    ],
)
def test_a_parameter_without_its_section_is_told_it(override, wanted):
    with pytest.raises(RecipeError, match=f"unknown section .*; did you mean {wanted}?"):
        compose("push_cube_small", [override])


def test_an_unknown_recipe_shows_the_main_ones():
    with pytest.raises(
        RecipeError, match=r"the main ones are cloth_move, .*, push_cube, .*reacher"
    ):
        compose("zzz")
    with pytest.raises(RecipeError, match="did you mean 'push_cube'"):
        compose("push_cub")


def test_recipes_are_listed_with_their_first_comment():
    listed = CliRunner().invoke(main, ["list", "recipe"]).output
    assert all(name in listed for name in recipe_names())
    assert "beside push_cube (adaln)" in " ".join(listed.split())


def test_an_unknown_name_tells_of_plugins_that_were_left_out():
    catalog = Catalog()
    catalog.add_plugin(plugin_of(codecs={"sound": "somewhere:Sound"}), "whole")
    catalog.problems.append(Problem("acwm_broken", "No module named 'nonsuch'"))
    with pytest.raises(RecipeError, match=r"'acwm_broken' was left out: No module named"):
        catalog.component("codec", "mine")
    assert catalog.component("codec", "sound").target == "somewhere:Sound"
