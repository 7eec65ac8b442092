"""Writes a package from templates, under the name that the author chose."""

from __future__ import annotations

import importlib.util
import keyword
import re
import shutil
from pathlib import Path
from typing import Any

import jinja2

from acwm_core.errors import RecipeError
from acwm_core.files import made_whole, training_record
from acwm_core.plugins import catalog
from acwm_templates.kinds import KINDS

FILES = Path(__file__).parent / "files"


def package_of(kind: str, name: str) -> str:
    """The name of the package; an estimator is called like its world, which has a package."""
    return f"acwm_{name}_estimator" if kind == "estimator" else f"acwm_{name}"


def write_package(
    kind: str,
    name: str,
    folder: Path,
    environment: str,
    weights: Path | None = None,
    gym: str | None = None,
) -> Path:
    """Write the package of a component. Either all files appear or none.

    Args:
        kind: one of `KINDS`.
        name: name of the component, in snake_case.
        folder: folder to create.
        environment: for a task, the environment that it is for.
        weights: for an estimator, those that `acwm train-estimator` wrote.
        gym: for an environment, the id of one of Gymnasium that it wraps.

    Raises:
        RecipeError: the name is invalid or taken, or the folder exists.
        RecipeError: there is no such environment, or the weights are others.
        DataError: the weights cannot be read.
    """
    registers = KINDS[kind].registers
    whole = f"{environment}.{name}" if kind == "task" else name
    package = package_of(kind, name)
    _check_name(registers, whole, name, package)
    _check_options(kind, weights, gym)
    if folder.exists():
        raise RecipeError(f"{folder} exists already; choose another --out")
    about: dict[str, Any] = {
        "kind": kind,
        "registers": registers,
        "registered": whole,
        "name": name,
        "package": package,
        "Name": "".join(word.capitalize() for word in name.split("_")),
        "title": name.replace("_", " "),
        "summary": KINDS[kind].summary,
        "use": KINDS[kind].use.replace("NAME", name),
    }
    if kind == "task":
        about |= _field_of(environment)
    if gym:
        about |= _described(gym, name)
    own = "gymnasium" if gym else "estimator_of_weights" if weights else kind
    written = {path: text for each in ("package", own) for path, text in _rendered(each, about)}
    with made_whole(folder) as made:
        for path, text in written.items():
            target = made / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        if weights:
            shutil.copyfile(weights, made / package / f"{name}.safetensors")
    return folder


def _check_name(registers: str, whole: str, name: str, package: str) -> None:
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        raise RecipeError(f"{name!r} cannot be its name: use snake_case, as in open_drawer")
    if whole in catalog().registry(registers):
        raise RecipeError(f"{registers} {whole!r} is installed already; choose another name")
    if importlib.util.find_spec(package) is not None:
        raise RecipeError(f"a package {package} is installed already; choose another name")


def _check_options(kind: str, weights: Path | None, gym: str | None) -> None:
    if weights and (kind != "estimator" or not weights.is_file()):
        what = "there is no such file" if kind == "estimator" else f"a {kind} has none"
        raise RecipeError(f"--weights {weights}: {what}")
    if weights and "layout" not in training_record(weights):
        raise RecipeError(f"--weights {weights}: `acwm train-estimator` did not write it")
    if gym and kind != "environment":
        raise RecipeError(f"--from-gym {gym}: only an environment can be made from one")


def _rendered(folder: str, about: dict[str, Any]) -> list[tuple[str, str]]:
    """Render the templates of a folder: pairs of the path in the package and the text."""
    pages = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FILES / folder),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found: list[tuple[str, str]] = []
    for template in sorted(pages.list_templates()):
        text = pages.get_template(template).render(about)
        if about["Name"] in _imported(text):
            raise RecipeError(
                f"{about['name']!r} is the name of a class that acwm itself uses in a "
                f"{about['kind']}; choose a more specific name"
            )
        place = template.removesuffix(".j2").replace("NAME", about["name"])
        if place.endswith(".py"):
            inside = "tests" if place.startswith("test_") else about["package"]
            place = f"{inside}/{place}"
        found.append((place, text))
    return found


def _imported(text: str) -> set[str]:
    """The names that a module imports from acwm itself."""
    lines = re.findall(r"^from acwm_(?:core|planning|sim)\S* import (.*)$", text, re.M)
    return {name for line in lines for name in line.split(", ")}


def _described(gym: str, name: str) -> dict[str, Any]:
    """What is written of an environment of Gymnasium, which is made for it once."""
    from acwm_templates.gymnasium_card import card_of

    card = card_of(gym, name)
    return {
        "env_id": gym,
        "card": card,
        "low": _tuple_text(card.action.low),
        "high": _tuple_text(card.action.high),
        "summary": card.summary.removesuffix("."),
    }


def _tuple_text(values: tuple[float, ...]) -> str:
    """A tuple as it is written, short if all values are equal."""
    return f"({values[0]!r},) * {len(values)}" if len({*values}) == 1 else repr(values)


def _field_of(environment: str) -> dict[str, Any]:
    """The state field that a new task of an environment measures at first."""
    card = catalog().component("environment", environment).load().card
    fields = {field.name: field for field in card.state}
    near = [name for name in fields if "position" in name] or [*fields]
    if not near:
        raise RecipeError(f"{environment} has no state that a task could measure")
    return {"environment": environment, "field": near[0], "unit": fields[near[0]].unit}
