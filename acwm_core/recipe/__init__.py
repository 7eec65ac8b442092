"""Recipes: YAML files and overrides become one checked description of an experiment."""

from acwm_core.recipe.compose import recipe_folder, recipe_names, recipe_summaries
from acwm_core.recipe.recipe import ComponentConfig, Recipe, compose, recipe_differences

__all__ = [
    "ComponentConfig",
    "Recipe",
    "compose",
    "recipe_differences",
    "recipe_folder",
    "recipe_names",
    "recipe_summaries",
]
