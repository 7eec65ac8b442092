"""Completions of arguments. They import nothing heavy, and return nothing after an error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pkgutil import resolve_name
from typing import Any, Literal, get_args, get_origin

import click
from click.shell_completion import CompletionItem

from acwm_core.errors import AcwmError
from acwm_core.plugins import catalog
from acwm_core.recipe.check import SECTIONS, check_names
from acwm_core.recipe.compose import (
    OVERLAYS,
    merge,
    read_layers,
    recipe_folder,
    recipe_names,
)
from acwm_core.recipe.objective import with_objective
from acwm_core.recipe.recipe import flat_items
from acwm_core.recipe.sections import COMPONENTS
from acwm_core.recipe.signature import signature
from acwm_core.recipe.types import show

Items = list[CompletionItem]


def components(ctx: click.Context, incomplete: str) -> Items:
    """Names of all components except commands."""
    kinds = [kind for kind in catalog().kinds if kind != "command"]
    summaries = dict(pair for kind in kinds for pair in _named(kind))
    return _starting(incomplete, summaries.items())


def environments(ctx: click.Context, incomplete: str) -> Items:
    """Names of environments."""
    return _starting(incomplete, _named("environment"))


def recipes(ctx: click.Context, incomplete: str) -> Items:
    """Recipes that come with acwm, and files, which the shell adds."""
    return [*_starting(incomplete, ((name, "") for name in recipe_names())), _files(incomplete)]


def experiments(ctx: click.Context, incomplete: str) -> Items:
    """Experiments by folder and name, recipes, and files, which the shell adds."""
    folders = (recipe_folder() / name for name in ("ablations", "benchmark"))
    paths = sorted(path for folder in folders for path in folder.glob("*.yaml"))
    named = ((f"{path.parent.name}/{path.stem}", "") for path in paths)
    return [*_starting(incomplete, named), *recipes(ctx, incomplete)]


def overrides(ctx: click.Context, incomplete: str) -> Items:
    """Keys with their current values in the recipe; after ``key=``, the possible values.

    Bash treats ``=`` as a separate word, so key and value arrive as separate words.
    """
    words = [*(ctx.params.get("overrides") or ())]
    key, joined, text = incomplete.partition("=")
    if joined:
        return _starting(incomplete, ((f"{key}={value}", "") for value in _values(ctx, key)))
    if len(words) > 1 and words[-1] == "=":
        return _starting(text or key, ((value, "") for value in _values(ctx, words[-2])))
    if words and not incomplete and "=" not in words[-1] and words[-1][0] != "+":
        return _starting("", ((value, "") for value in _values(ctx, words[-1])))
    overlays = sorted((recipe_folder() / OVERLAYS).glob("*.yaml"))
    named = [(f"+{path.stem}", "overlay") for path in overlays]
    return _starting(incomplete, [*_keys(ctx), *named])


def _keys(ctx: click.Context) -> Iterator[tuple[str, str]]:
    for key, value in flat_items(_recipe(ctx)):
        key = key.removesuffix(".name") if key.removesuffix(".name") in COMPONENTS else key
        text = show(value)
        yield f"{key}={text if text.replace('.', '').replace('-', '').isalnum() else ''}", ""


def _values(ctx: click.Context, key: str) -> list[str]:
    """The names of components, and the possible values of a parameter if its type lists them."""
    section, _, parameter = key.partition(".")
    kind = "environment" if section == "env" else section
    if section in COMPONENTS and not parameter:
        return [name for name, _ in _named(kind)]
    if section not in SECTIONS:
        return []
    takes = signature(resolve_name(SECTIONS[section])).parameters
    expected = takes[parameter].type if parameter in takes else None
    choices = get_args(expected) if get_origin(expected) is Literal else ()
    return ["true", "false"] if expected is bool else [str(choice) for choice in choices]


def _recipe(ctx: click.Context) -> dict[str, Any]:
    """The recipe on the command line, with the defaults that are known without importing torch."""
    name = ctx.params.get("recipe") or ctx.params.get("file")
    if not name:
        return {}
    try:
        recipe = with_objective(merge(*read_layers(name), quick=True))
        recipe |= check_names(recipe)
    except AcwmError:
        return {}
    for section in COMPONENTS:
        if chosen := recipe.get(section):
            kind = "environment" if section == "env" else section
            recipe[section] = {**catalog().component(kind, chosen["name"]).defaults, **chosen}
    return recipe


def _named(kind: str) -> list[tuple[str, str]]:
    return [(component.name, component.summary) for component in catalog().registry(kind)]


def _starting(incomplete: str, summaries: Iterable[tuple[str, str]]) -> Items:
    return [
        CompletionItem(value, help=about or None)
        for value, about in sorted(summaries)
        if value.startswith(incomplete)
    ]


def _files(incomplete: str) -> CompletionItem:
    return CompletionItem(incomplete, type="file")


COMPLETIONS = {
    "name": components,
    "environment": environments,
    "recipe": recipes,
    "file": experiments,
    "overrides": overrides,
}
"""Functions by the name of the argument that they complete."""
