"""From recipe files and command-line words to one dict: `extends`, deep merge, swaps by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from acwm_core.errors import RecipeError, suggest
from acwm_core.recipe.text import parse

PARTS = ("env", "codec", "model", "conditioner")
"""Sections that hold a part: a registered name and its parameters."""


def read_recipe(name: str | Path, words: Sequence[str] = ()) -> dict[str, Any]:
    """Read a recipe file with all that it extends, and apply words to it.

    Args:
        name: a path, or the name of a packaged recipe such as ``push_cube_small``.
        words: ``section.parameter=value`` or ``part=name``; values are YAML. Their order does not
            matter, except that the last of two words for one parameter counts.

    Raises:
        RecipeError: a file that is missing, extends itself or is no YAML, or a malformed word.
    """
    return with_words(_read(_find(str(name), Path()), ()), words)


def with_words(recipe: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """A composed recipe with words applied to it.

    Raises:
        RecipeError: a malformed word.
    """
    changes: dict[str, Any] = {}
    for word in words:
        changes = _merged(changes, parse_word(word))
    return merge(recipe, changes)


def parse_word(word: str) -> dict[str, Any]:
    """The nested dict that ``flow.shift=5`` stands for.

    Raises:
        RecipeError: no ``=``, an empty name, or a value that is no YAML.
    """
    path, equals, text = word.partition("=")
    names = path.split(".")
    if not equals or not all(names):
        raise RecipeError(
            f"{word!r} is not a word for a recipe; write section.parameter=value or part=name"
        )
    value: Any = _normal(path, parse(text, f"the value of {word!r}"))
    for name in reversed(names):
        value = {name: value}
    return value


def merge(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Deep merge of recipes; a part that changes its name drops its old parameters."""
    kept = {
        section: value
        for section, value in base.items()
        if section not in PARTS or not _renamed(value, changes.get(section))
    }
    return _merged(kept, changes)


def recipe_folder() -> Path:
    """The folder of the recipes that come with acwm, in a wheel or in a checkout."""
    package = Path(__file__).parents[1]
    packaged = package / "recipes"
    return packaged if packaged.is_dir() else package.parent / "recipes"


def recipe_names() -> list[str]:
    """Names of the recipes that come with acwm and stand on their own."""
    return sorted(path.stem for path in recipe_folder().glob("*.yaml") if path.stem != "base")


def _read(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
    """One file merged over everything it extends, in order."""
    if path in above:
        circle = " → ".join(p.name for p in (*above[above.index(path) :], path))
        raise RecipeError(f"recipes extend each other in a circle: {circle}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"cannot read the recipe {path}: {error}") from error
    content: Any = parse(text, str(path)) or {}
    if not isinstance(content, dict):
        raise RecipeError(f"{path} is no recipe: it must hold sections such as `model: dit_s`")
    own = cast(dict[Any, Any], content)
    extends = own.pop("extends", [])
    extends = [extends] if isinstance(extends, str) else extends
    if not isinstance(extends, list) or not all(
        isinstance(e, str) for e in cast(list[Any], extends)
    ):
        raise RecipeError(f"`extends` in {path} must be a list of recipe files")
    recipe: dict[str, Any] = {}
    for name in cast(list[str], extends):
        recipe = merge(recipe, _read(_find(name, path.parent), (*above, path)))
    return merge(recipe, {str(section): _normal(str(section), v) for section, v in own.items()})


def _find(name: str, folder: Path) -> Path:
    """A recipe file beside `folder`, or one that comes with acwm.

    Raises:
        RecipeError: there is none; suggests the nearest.
    """
    file = name if name.endswith((".yaml", ".yml")) else f"{name}.yaml"
    places = [folder / name, folder / file, recipe_folder() / file]
    for path in places:
        if path.is_file():
            return path.resolve()
    beside = [str(Path(name).parent / path.name) for path in (folder / file).parent.glob("*.yaml")]
    shipped = [str(path.relative_to(recipe_folder())) for path in recipe_folder().rglob("*.yaml")]
    known = [*beside, *shipped]
    if file != name:
        known = [path.removesuffix(".yaml") for path in known]
    raise RecipeError(f"there is no recipe {name!r}{suggest(name, set(known))}")


def _normal(section: str, value: Any) -> Any:
    """The short form ``model: dit_s`` written out."""
    if section in PARTS and value is not None and not isinstance(value, Mapping):
        return {"name": value}
    return value  # pyright: ignore[reportUnknownVariableType]


def _renamed(old: Mapping[str, Any] | None, new: Mapping[str, Any] | None) -> bool:
    return bool(old) and bool(new) and "name" in new and new["name"] != old.get("name")


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            merged[key] = _merged(cast(dict[str, Any], old), cast(dict[str, Any], value))
        else:
            merged[key] = value
    return merged
