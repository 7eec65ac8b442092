"""The pages of all components and of all keys of a recipe, from constructors and their docstrings.

Nothing is imported for it: constructors are read as the check of a recipe reads them.
"""

import ast
import re
from collections.abc import Collection, Iterator, Mapping
from typing import Any, cast

from tables import cell, code, table

from acwm_core.plugins import COMPONENT_KINDS, Component, catalog
from acwm_core.recipe.check import FITTED, SECTIONS
from acwm_core.recipe.signature import ModuleSource, Parameter, load, signature

IN_RECIPES = {
    "environment": "env",
    "codec": "codec",
    "model": "model",
    "conditioner": "conditioner",
}
"""Kinds of components in a recipe, and their sections."""

_ENTRY = re.compile(r"^( +)\**([\w, ]+?)(?: \([^)]*\))?: (.*(?:\n\1 +.*)*)", re.M)
_WORDS = {
    "flow": "How a denoiser learns and is sampled.",
    "trainer": "Flags of Lightning's `Trainer`.",
}
_EVERY_WORLD = ("size", "render_mode")
"""Parameters that all environments have: see the class `Environment`."""

_COLUMNS = ("Type", "Default", "What it is")


def components_page() -> str:
    """Every component by kind, with the parameters that can be set."""
    parts: list[str] = []
    for kind in COMPONENT_KINDS:
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
    for section, target in SECTIONS.items():
        summary = _WORDS.get(section) or cell(_docstring(target).partition("\n\n")[0])
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
    takes = component.kind not in ("table", "trained_model", "protocol")
    rows = _parameters(component.target, component.defaults, fitted) if takes else ()
    return [
        f"### {component.name} {{: #{anchor} }}",
        " ".join(facts),
        table(("Parameter", *_COLUMNS), rows),
    ]


def _parameters(
    target: str, preset: Mapping[str, Any], fitted: Collection[str], before: str = ""
) -> Iterator[tuple[str, str, str, str]]:
    takes = signature(target)
    texts = _descriptions(target)
    for name, parameter in (takes.parameters if takes else {}).items():
        if name in fitted:
            continue
        shown = code(before + name), code(_type(parameter)), code(_default(parameter, name, preset))
        yield *shown, cell(texts.get(name, ""))


def _type(parameter: Parameter) -> str:
    """The annotation as written; aliases of a Literal are replaced by their values."""
    node = parameter.annotation
    found = parameter.source.find(node.id) if isinstance(node, ast.Name) else None
    if found and isinstance(found[1], ast.Assign):
        node = found[1].value
    if isinstance(node, ast.Constant) and isinstance(node.value, str):  # quoted in the source
        node = ast.parse(node.value, mode="eval").body
    return _words(node) if node else ""


def _words(node: ast.expr) -> str:
    """A type as error messages show it: `'velocity' or 'clean'`, `int or null`."""
    if isinstance(node, ast.BinOp):
        return f"{_words(node.left)} or {_words(node.right)}"
    if isinstance(node, ast.Constant) and node.value is None:
        return "null"
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal":
        choices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        return " or ".join(map(ast.unparse, choices))
    return ast.unparse(node)


def _default(parameter: Parameter, name: str, preset: Mapping[str, Any]) -> str:
    if name in preset:
        return repr(preset[name])
    if parameter.value is None:
        return "required"
    return ast.unparse(parameter.value) if parameter.default is ... else repr(parameter.default)


def _descriptions(target: str) -> dict[str, str]:
    """Descriptions of parameters in the docstrings of a class, its constructor and its bases."""
    found: dict[str, str] = {}
    for node, _ in reversed(list(_classes(target))):
        own = [item for item in node.body if isinstance(item, ast.FunctionDef)]
        texts = [ast.get_docstring(each) or "" for each in own if each.name == "__init__"]
        for text in (ast.get_docstring(node) or "", *texts):
            for _, names, description in _ENTRY.findall(text):
                first = re.split(r"\n\s*\n|(?<=\.)\s+(?=::|\.\. )", description)[0]
                found |= {name.strip(): first for name in names.split(",")}
    return found


def _docstring(target: str) -> str:
    return ast.get_docstring(next(_classes(target))[0]) or ""


def _classes(target: str) -> Iterator[tuple[ast.ClassDef, ModuleSource]]:
    """A class and its bases, in the order of the source; a function has no bases."""
    module, _, name = target.partition(":")
    source = load(module)
    found = source.find(name) if source else None
    if found is None:
        return
    source, node = found
    if isinstance(node, ast.FunctionDef):
        node = ast.ClassDef(name, [], [], node.body, [])
    if not isinstance(node, ast.ClassDef):
        return
    yield cast(ast.ClassDef, node), source
    for base in node.bases:
        above, _, parent = source.dotted(base).rpartition(".")
        if above:
            yield from _classes(f"{above}:{parent}")
        elif parent in source.definitions:
            yield from _classes(f"{module}:{parent}")
