"""Read the parameters of a constructor from its source, to check recipes without importing it.

Imports, base classes and type aliases are followed from file to file, which takes milliseconds.
Whatever cannot be read stays open (`Any`).
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.machinery
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_VOCABULARY = {"builtins", "typing", "typing_extensions", "collections.abc", "pathlib", "datetime"}
"""Modules whose names may be used in annotations that are checked."""

_PLAIN_BASES = {"abc.ABC", "object", "torch.nn.Module", "typing.Generic", "typing.Protocol"}
"""Base classes whose constructors have no parameters that a recipe could set."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a constructor."""

    annotation: ast.expr | None  # its type annotation, if any
    value: ast.expr | None  # its default expression; None if it is required
    source: ModuleSource  # the file that it is read from

    @property
    def type(self) -> Any:
        """The type as a Python object; `Any` where it is not known without importing."""
        return annotated_type(self.annotation, self.source) if self.annotation else Any

    @property
    def default(self) -> Any:
        """The default if it is a literal or the name of a constant, else `...`."""
        value = self.value
        if isinstance(value, ast.Name) and (found := self.source.find(value.id)):
            value = getattr(found[1], "value", None)
        try:
            return ast.literal_eval(value) if value else ...
        except ValueError:
            return ...


@dataclass(frozen=True)
class Signature:
    """The named parameters of a class or function."""

    owner: str  # the name of the class or function
    parameters: Mapping[str, Parameter]  # its keyword parameters, in order
    open: bool = False  # whether it also has parameters that could not be read


@functools.cache
def signature(target: str) -> Signature | None:
    """Read the signature of ``"package.module:Name"``; None if it does not exist.

    A target without a readable file (compiled, or defined in a notebook) has an open signature.
    """
    module, _, name = target.partition(":")
    source = load(module)
    if source is None:
        is_there = module in sys.modules or _spec(module.partition(".")[0])
        return Signature(name, {}, open=True) if is_there else None
    if (found := source.find(name)) is None:
        return None
    source, node = found
    if isinstance(node, ast.ClassDef):
        return _constructor(node, source) or Signature(name, {})
    if isinstance(node, ast.FunctionDef):
        return Signature(name, _arguments(node, source), open=node.args.kwarg is not None)
    return Signature(name, {}, open=True)


def _constructor(node: ast.ClassDef, source: ModuleSource) -> Signature | None:
    decorators = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    base = _inherited(node, source)
    own: dict[str, Parameter] = {}
    if any(source.dotted(d) == "dataclasses.dataclass" for d in decorators):
        base = base or Signature("", {})
        own = dict(_fields(node, source))
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            own = _arguments(item, source, skip=1)
            if item.args.kwarg is None:
                return Signature(node.name, own)
            base = base or Signature("", {}, open=True)
    return base and Signature(node.name, {**base.parameters, **own}, base.open)


def _inherited(node: ast.ClassDef, source: ModuleSource) -> Signature | None:
    """The constructor of the first base class that has one; open if a base cannot be read."""
    for base in node.bases:
        dotted = source.dotted(base)
        if dotted in _PLAIN_BASES:
            continue
        module, _, name = dotted.rpartition(".")
        home = load(module) if module else source
        found = home.find(name) if home else None
        if found is None or not isinstance(found[1], ast.ClassDef):
            return Signature(name, {}, open=True)
        if inherited := _constructor(found[1], found[0]):
            return inherited
    return None


def _arguments(node: ast.FunctionDef, source: ModuleSource, skip: int = 0) -> dict[str, Parameter]:
    arguments = node.args
    positional = [*arguments.posonlyargs, *arguments.args]
    padding = [None] * (len(positional) - len(arguments.defaults))
    given = [*zip(positional, [*padding, *arguments.defaults], strict=True)][skip:]
    keyword = [pair for pair in given if pair[0] not in arguments.posonlyargs]
    keyword += zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    return {a.arg: Parameter(a.annotation, value, source) for a, value in keyword}


def _fields(node: ast.ClassDef, source: ModuleSource) -> Iterator[tuple[str, Parameter]]:
    for item in node.body:
        if not isinstance(item, ast.AnnAssign) or not isinstance(item.target, ast.Name):
            continue
        value = item.value
        if source.dotted(item.annotation) in ("typing.ClassVar", "dataclasses.KW_ONLY"):
            continue
        if isinstance(value, ast.Call) and source.dotted(value.func) == "dataclasses.field":
            options = {keyword.arg: keyword.value for keyword in value.keywords}
            if "init" in options and ast.unparse(options["init"]) == "False":
                continue
            value = options.get("default", options.get("default_factory"))
        yield item.target.id, Parameter(item.annotation, value, source)


class ModuleSource:
    """A module's source file: its top-level definitions, and where imported names come from."""

    def __init__(self, name: str, path: Path) -> None:
        self.definitions: dict[str, ast.stmt] = {}
        self.imports: dict[str, str] = {}
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for statement in _flat(ast.parse(path.read_text(encoding="utf-8")).body):
            match statement:
                case ast.Import(names):
                    for alias in names:
                        name = alias.name if alias.asname else alias.name.partition(".")[0]
                        self.imports[alias.asname or name] = name
                case ast.ImportFrom(module, names, level):
                    above = package.split(".")[: -(level - 1) or None] if level else []
                    origin = ".".join([*above, *([module] if module else [])])
                    self.imports |= {a.asname or a.name: f"{origin}.{a.name}" for a in names}
                case ast.ClassDef(name) | ast.FunctionDef(name):
                    self.definitions[name] = statement
                case ast.Assign([ast.Name(name)]) | ast.AnnAssign(ast.Name(name)):
                    self.definitions[name] = statement
                case _:
                    pass

    def dotted(self, node: ast.expr) -> str:
        """The full name ``"package.module.Name"`` of a name or attribute, as far as known."""
        if isinstance(node, ast.Subscript):
            return self.dotted(node.value)
        if isinstance(node, ast.Attribute):
            return f"{self.dotted(node.value)}.{node.attr}"
        name = node.id if isinstance(node, ast.Name) else "?"
        return self.imports.get(name, name)

    def find(self, name: str) -> tuple[ModuleSource, ast.stmt] | None:
        """The definition of a top-level name, here or where it was imported from."""
        source: ModuleSource | None = self
        for _ in range(16):  # follow re-exports; bounded, because they may be circular
            if source is None or name in source.definitions:
                break
            module, _, name = source.imports.get(name, "").rpartition(".")
            source = load(module)
        return (source, source.definitions[name]) if source and name in source.definitions else None


@functools.cache
def load(module: str) -> ModuleSource | None:
    """Read a module's source file without importing it; None if it has no Python file."""
    loaded = getattr(sys.modules.get(module), "__file__", None)
    top, *rest = module.split(".")
    # Only for the top-level name: for a dotted one, find_spec would import the parent packages.
    spec = None if loaded else _spec(top)
    if spec and rest:
        folders = [Path(folder, *rest) for folder in spec.submodule_search_locations or ()]
        paths = [path for f in folders for path in (f.with_suffix(".py"), f / "__init__.py")]
    else:
        paths = [Path(loaded or (spec and spec.origin) or "")]
    found = next((path for path in paths if path.suffix == ".py" and path.is_file()), None)
    return ModuleSource(module, found) if found else None


def _spec(top: str) -> importlib.machinery.ModuleSpec | None:
    try:
        return importlib.util.find_spec(top)
    except (ImportError, ValueError):  # ValueError: "" or a module that has no spec
        return None


def _flat(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    for statement in body:
        if isinstance(statement, (ast.If, ast.Try)):
            yield from _flat([*statement.body, *statement.orelse])
        else:
            yield statement


def annotated_type(annotation: ast.expr, source: ModuleSource) -> Any:
    """Evaluate an annotation; names of its file that are not plain types become `Any`."""
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        annotation = ast.parse(annotation.value, mode="eval").body
    code = compile(ast.Expression(annotation), "<annotation>", "eval")
    try:
        return eval(code, {"__builtins__": {}}, _Names(source))
    except Exception:  # an attribute or subscript of a name that became `Any`
        return Any


class _Names(dict[str, Any]):
    def __init__(self, source: ModuleSource) -> None:
        self._source = source

    def __missing__(self, name: str) -> Any:
        local = name in self._source.definitions
        dotted = "" if local else self._source.imports.get(name, f"builtins.{name}")
        module, _, attribute = dotted.rpartition(".")
        if dotted in _VOCABULARY:
            return importlib.import_module(dotted)
        if module in _VOCABULARY:
            value = getattr(importlib.import_module(module), attribute, Any)
            if attribute == "Iterable":  # as in YAML; pydantic would check items lazily
                return list
            return value if module != "builtins" or isinstance(value, type) else Any
        source, node = self._source.find(name) or (self._source, None)
        alias = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
        return annotated_type(alias, source) if alias else Any
