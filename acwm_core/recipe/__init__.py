"""Recipes: YAML files and words to one checked description of an experiment, without torch."""

from acwm_core.recipe.compose import parse_word, recipe_folder, recipe_names
from acwm_core.recipe.recipe import PartChoice, Recipe, compose

__all__ = ["PartChoice", "Recipe", "compose", "parse_word", "recipe_folder", "recipe_names"]
