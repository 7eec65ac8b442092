"""The pages of all components and of all keys of a recipe: constructors and their docstrings."""

import inspect
import json
import re
from collections.abc import Collection, Iterator, Mapping
from pkgutil import resolve_name
from typing import Any

from tables import cell, code, table

from acwm_core.plugins import Component, catalog
from acwm_core.recipe.check import FITTED, SECTIONS
from acwm_core.recipe.signature import REQUIRED, Parameter, signature
from acwm_core.recipe.types import describe

IN_RECIPES = {
    "environment": "env",
    "codec": "codec",
    "model": "model",
    "conditioner": "conditioner",
    "objective": "objective",
}
"""Kinds of components in a recipe, and their sections."""

_ENTRY = re.compile(r"^( +)\**([\w, ]+?)(?: \([^)]*\))?: (.*(?:\n\1 +.*)*)", re.M)
_WORDS = {
    "trainer": "Flags of Lightning's `Trainer`.",
}
_EVERY_WORLD = ("size", "render_mode")
"""Parameters that all environments have: see the class `Environment`."""

_COLUMNS = ("Type", "Default", "What it is")


def components_page() -> str:
    """Every component by kind, with the parameters that can be set."""
    parts: list[str] = []
    for kind in catalog().kinds:
        found = list(catalog().registry(kind))
        if kind in ("command", "task") or not found:  # tasks are named with their environment
            continue
        name = kind.replace("_", " ")
        parts.append(f"## {name[0].upper() + name[1:]}s")
        if kind == "estimator":  # one per environment, made from its card
            rows = [(f"`{each.name}`", cell(each.summary)) for each in found]
            parts.append(table(("Name", "What it reads"), rows))
            continue
        for each in found:
            parts += _component(each)
    return "\n\n".join(part for part in parts if part)


def recipe_keys_page() -> str:
    """Every key of a recipe by section; those of components are on their page."""
    parts: list[str] = []
    for kind, section in IN_RECIPES.items():
        names = ", ".join(f"`{each.name}`" for each in catalog().registry(kind))  # pyright: ignore
        parts.append(
            f"## {section}\n\n`{section}: NAME`, or a mapping with `name` and parameters. {names}: "
            f"see [their parameters](components.md#{kind}s)."
        )
    targets = {**SECTIONS, "trainer": "lightning.pytorch.trainer.trainer:Trainer"}
    for section, name in targets.items():
        target = resolve_name(name)
        summary = _WORDS.get(section) or cell((inspect.getdoc(target) or "").partition("\n\n")[0])
        summary = re.sub(r"^The recipe's section `\w+`: (.)", lambda m: m[1].upper(), summary)
        rows = _parameters(target, {}, (), f"{section}.")
        parts.append(f"## {section}\n\n{summary}\n\n{table(('Key', *_COLUMNS), rows)}")
    return "\n\n".join(parts)


def _component(component: Component) -> list[str]:
    facts = [cell(component.summary[:1].upper() + component.summary[1:]) + "."]
    if component.tasks:
        facts.append(f"Tasks: {', '.join(f'`{name}`' for name in component.tasks)}.")
    if component.extra:
        facts.append(f"Needs `pip install '{component.distribution}[{component.extra}]'`.")
    facts.append(f"Plugin `{component.plugin}`.")
    anchor = f"{component.kind}-{component.name}"
    fitted = {"environment": _EVERY_WORLD, **FITTED}.get(component.kind, ())
    takes = component.kind not in ("trained_model", "protocol")
    fitted = (*fitted, *(getattr(component.load(), "fitted_parameters", ()) if takes else ()))
    rows = _parameters(component.load(), component.defaults, fitted) if takes else ()
    return [
        f"### {component.name} {{: #{anchor} }}",
        " ".join(facts),
        table(("Parameter", *_COLUMNS), rows),
    ]


def _parameters(
    target: Any, preset: Mapping[str, Any], fitted: Collection[str], before: str = ""
) -> Iterator[tuple[str, str, str, str]]:
    texts = _descriptions(target)
    for name, parameter in signature(target).parameters.items():
        if name not in fitted:
            kind = "" if parameter.type is Any else describe(parameter.type)
            default = code(_default(parameter, name, preset))
            yield code(before + name), code(kind), default, cell(texts.get(name, ""))


def _default(parameter: Parameter, name: str, preset: Mapping[str, Any]) -> str:
    default = preset.get(name, parameter.default)
    if default is REQUIRED:
        return "required"
    try:
        json.dumps(default)
    except TypeError:
        return ""  # a factory's, or an object
    return repr(default)


def _descriptions(target: Any) -> dict[str, str]:
    """Descriptions of parameters in the docstrings of a class, its constructor and its bases."""
    found: dict[str, str] = {}
    for each in reversed(target.__mro__[:-1] if isinstance(target, type) else (target,)):
        constructor = vars(each).get("__init__")
        for text in (each.__doc__, constructor and constructor.__doc__):
            for _, names, description in _ENTRY.findall(inspect.cleandoc(text or "")):
                first = re.split(r"\n\s*\n|(?<=\.)\s+(?=::|\.\. )", description)[0]
                found |= {name.strip(): first for name in names.split(",")}
    return found
