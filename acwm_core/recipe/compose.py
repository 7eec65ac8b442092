"""Compose recipe files and overrides into one dict: `extends`, deep merge, component swaps."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from acwm_core.errors import AcwmWarning, DataError, RecipeError, suggest
from acwm_core.plugins import catalog
from acwm_core.recipe.former import current_sections
from acwm_core.recipe.objective import Layer, objective_section, with_objective
from acwm_core.recipe.sections import COMPONENTS, deep_merge, mapping_or_empty, written_out
from acwm_core.recipe.text import parse

OVERLAYS = "overlays"
"""Folder in which ``+NAME`` is looked up: beside the recipe, then among packaged recipes."""

OVERLAY = "+"
"""What an override begins with that is an overlay."""

ADVISOR = "advisor"
"""Key of a recipe file that names what advises on overlays, see `acwm_core.recipe.advice`."""

VARIANTS = "paper"
"""Folder of the packaged recipes that vary another one."""

FORMER_PARAMETERS = {"training.agent_steps": "objective.motion_steps"}
"""Parameters that overrides may name by what they were called before."""


def read_recipe(name: str | Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Read a recipe file with all recipes it extends, and apply overrides to it.

    Args:
        name: a path, or the name of a packaged recipe such as ``push_cube_small``.
        overrides: ``+overlay``, ``section.parameter=value`` or ``component=name``; values are
            YAML. Order matters only between two overrides of one parameter (the last one
            counts) and between overlays, which are applied in order.
    """
    return merge(*read_layers(name, overrides))


def read_layers(name: str | Path, overrides: Sequence[str] = ()) -> list[Layer]:
    """What `read_recipe` merges: a layer per file, and one for the overrides."""
    path = find_recipe(str(name), Path())
    return _with_overrides(_with_file([], path), overrides, path.parent)


def with_overrides(recipe: Layer, overrides: Sequence[str]) -> dict[str, Any]:
    """Apply overlays, and then the other overrides, to a composed recipe."""
    return merge(*_with_overrides([recipe], overrides, Path()))


def parse_override(override: str) -> dict[str, Any]:
    """Parse an override such as ``objective.shift=5`` into a nested dict.

    Raises:
        RecipeError: there is no ``=``, a name is empty, or the value is not YAML.
    """
    path, equals, text = override.partition("=")
    names = path.split(".")
    if not equals or not all(names):
        raise RecipeError(
            f"{override!r} is not an override; write section.parameter=value, "
            "component=name or +overlay"
        )
    value: Any = parse(text, f"the value of {override!r}")
    if path in FORMER_PARAMETERS:
        path = FORMER_PARAMETERS[path]
        message = f"{override} is now called {path}={text}"
        warnings.warn(message, AcwmWarning, stacklevel=2)
        names = path.split(".")
    for name in reversed(names[1:]):
        value = {name: value}
    return {names[0]: written_out(names[0], value)}


def merge(*layers: Layer, quick: bool = False) -> dict[str, Any]:
    """Deep-merge layers, the last one on top; a component that changes drops its old parameters.

    Args:
        quick: leave out the parameters that a new objective keeps (`objective_section`).
    """
    recipe: dict[str, Any] = {}
    for layer in layers:
        for section in COMPONENTS:
            old, new = recipe.get(section), layer.get(section)
            if old and new and "name" in new and new["name"] != old.get("name"):
                recipe[section] = {}
        recipe = deep_merge(recipe, layer)
    objective = objective_section(layers, quick=quick)
    return {**recipe, "objective": objective} if objective else recipe


def recipe_folder() -> Path:
    """The folder of the packaged recipes, in an installed wheel or in a checkout."""
    package = Path(__file__).parents[1]
    packaged = package / "recipes"
    return packaged if packaged.is_dir() else package.parent / "recipes"


def recipe_files() -> dict[str, Path]:
    """The packaged recipes that are complete by themselves, by name."""
    folder = recipe_folder()
    paths = [*folder.glob("*.yaml"), *(folder / VARIANTS).glob("*.yaml")]
    return {path.stem: path for path in sorted(paths, key=lambda p: p.stem) if path.stem != "base"}


def recipe_names() -> list[str]:
    """The names of `recipe_files`."""
    return [*recipe_files()]


def recipe_summaries() -> dict[str, str]:
    """The first comment line of each of `recipe_files`, by name."""
    texts = {name: path.read_text("utf-8") for name, path in recipe_files().items()}
    return {name: text.splitlines()[0].lstrip("# ") for name, text in texts.items()}


def advisor_of(name: str | Path) -> str | None:
    """What advises on overlays of this recipe file, if the file itself says so."""
    named: Any = _content(find_recipe(str(name), Path())).get(ADVISOR)
    return named if isinstance(named, str) else None


def _with_overrides(layers: list[Layer], overrides: Sequence[str], folder: Path) -> list[Layer]:
    """The layers with overlays, of which those in `folder` come first, and with overrides."""
    changes: dict[str, Any] = {}
    for override in overrides:
        if override.startswith(OVERLAY):
            layers = _with_file(layers, _find_overlay(override, folder))
        else:
            changes = deep_merge(changes, parse_override(override))
    return [*layers, changes]


def _with_file(layers: list[Layer], path: Path, above: tuple[Path, ...] = ()) -> list[Layer]:
    if path in above:
        circle = " → ".join(p.name for p in (*above[above.index(path) :], path))
        raise RecipeError(f"recipes extend each other in a circle: {circle}")
    own = {section: written_out(section, value) for section, value in _content(path).items()}
    extends: Any = own.pop("extends", [])
    own.pop(ADVISOR, None)
    names = cast(list[Any], extends if isinstance(extends, list) else [extends])
    if not all(isinstance(name, str) for name in names):
        raise RecipeError(f"`extends` in {path} must be a list of recipe files")
    for name in names:
        layers = _with_file(layers, find_recipe(name, path.parent), (*above, path))
    layers = _with_replacements(layers, own.pop("replace", {}), path)
    changes = current_sections(own, merge(*layers, quick=True).get("model"))
    codec: dict[str, Any] = changes.get("codec") or {}
    for name, value in codec.items():  # a trained model's folder contains its codec's files
        if isinstance(value, str) and (path.parent / value).is_file():
            codec[name] = str(path.parent / value)
    return [*layers, changes]


def _content(path: Path) -> dict[str, Any]:
    try:
        text = path.read_bytes().decode()
    except (OSError, UnicodeDecodeError, DataError) as error:
        raise RecipeError(f"cannot read the recipe {path}: {error}") from error
    content: Any = parse(text, str(path)) or {}
    if not isinstance(content, dict):
        raise RecipeError(f"{path} is not a recipe: it must have sections such as `model: dit_s`")
    return {str(section): value for section, value in cast(dict[Any, Any], content).items()}


def _with_replacements(layers: list[Layer], replacements: Any, path: Path) -> list[Layer]:
    """Replace values of the recipe that the section `replace` of an overlay lists.

    ``{"model": {"dit_s": "dit_xs"}, "data.path": {"data/a": "data/b"}}`` replaces the model if it
    is dit_s, and the path if it is data/a. Values that are not listed stay as they are.
    """
    if not isinstance(replacements, Mapping) or not all(
        isinstance(table, Mapping) for table in cast(Mapping[Any, Any], replacements).values()
    ):
        raise RecipeError(f"`replace` in {path} must list replacements, as in model: {{old: new}}")
    for name, table in cast(Mapping[str, Mapping[Any, Any]], replacements).items():
        section, _, parameter = str(name).partition(".")
        recipe = with_objective(merge(*layers, quick=section != "objective" or not parameter))
        old = mapping_or_empty(recipe.get(section)).get(parameter or "name")
        new = table.get(old) if isinstance(old, str) else None
        if new is not None:
            change = {parameter: new} if parameter else written_out(section, new)
            layers = [*layers, {section: change}]
    return layers


def _find_overlay(override: str, folder: Path) -> Path:
    places = [folder / OVERLAYS, recipe_folder() / OVERLAYS]
    known = {path.stem: path for place in reversed(places) for path in place.glob("*.yaml")}
    if override[1:] not in known:
        names = {f"+{name}" for name in known}
        raise RecipeError(f"there is no overlay {override!r}{suggest(override, names)}")
    return known[override[1:]].resolve()


def find_recipe(name: str, folder: Path) -> Path:
    """Find a recipe file in `folder`, or a packaged one, which may lie in a subfolder.

    Raises:
        RecipeError: there is none; suggests the most similar name.
    """
    file = name if name.endswith((".yaml", ".yml")) else f"{name}.yaml"
    shipped = recipe_folder()
    for path in (folder / name, folder / file, shipped / file, *sorted(shipped.glob(f"*/{file}"))):
        if path.is_file():
            return path.resolve()
        if path.exists() and path.suffix:
            raise RecipeError(f"{path} is not a file: it is a folder, a pipe or a device")
    known = {str(Path(name).parent / path.name) for path in (folder / file).parent.glob("*.yaml")}
    known |= {str(path.relative_to(shipped)) for path in shipped.rglob("*.yaml")}
    if file != name:
        known = {path.removesuffix(".yaml") for path in known}
    near = suggest(name, known)
    if "did you mean" not in near:
        main = [recipe for recipe in recipe_names() if recipe in catalog().registry("environment")]
        near = f"; the main ones are {', '.join(main)} (see `acwm list recipe`)"
    raise RecipeError(f"there is no recipe {name!r}{near}")
