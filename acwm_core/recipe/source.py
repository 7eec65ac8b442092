"""Python files read as text: what a module defines, imports and means by an annotation.

Importing a model means importing torch, an environment its simulator; reading the file that
defines it takes milliseconds. Imports, base classes and type aliases are followed from file to
file. What cannot be read stays open (`Any`).
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.machinery
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_VOCABULARY = {"builtins", "typing", "typing_extensions", "collections.abc", "pathlib", "datetime"}
"""Modules whose names may stand in an annotation that is checked."""


class ModuleSource:
    """One module's file: its top-level definitions, and where its imported names come from."""

    def __init__(self, name: str, path: Path) -> None:
        self.definitions: dict[str, ast.stmt] = {}
        self.imports: dict[str, str] = {}
        self._package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for statement in _flat(ast.parse(path.read_text(encoding="utf-8")).body):
            self._read(statement)

    def _read(self, statement: ast.stmt) -> None:
        match statement:
            case ast.Import(names):
                for alias in names:
                    name = alias.name if alias.asname else alias.name.partition(".")[0]
                    self.imports[alias.asname or name] = name
            case ast.ImportFrom(module, names, level):
                above = self._package.split(".")[: -(level - 1) or None] if level else []
                origin = ".".join([*above, *([module] if module else [])])
                self.imports |= {a.asname or a.name: f"{origin}.{a.name}" for a in names}
            case ast.ClassDef(name) | ast.FunctionDef(name):
                self.definitions[name] = statement
            case ast.Assign([ast.Name(name)]) | ast.AnnAssign(ast.Name(name)):
                self.definitions[name] = statement
            case _:
                pass

    def dotted(self, node: ast.expr) -> str:
        """``"package.module.Name"`` of a name or attribute, as far as the imports tell."""
        if isinstance(node, ast.Subscript):
            return self.dotted(node.value)
        if isinstance(node, ast.Attribute):
            return f"{self.dotted(node.value)}.{node.attr}"
        name = node.id if isinstance(node, ast.Name) else "?"
        return self.imports.get(name, name)

    def find(self, name: str) -> tuple[ModuleSource, ast.stmt] | None:
        """The definition of a top-level name, here or where it was imported from."""
        source: ModuleSource | None = self
        for _ in range(16):  # re-exports of re-exports; bounded, because they may go in circles
            if source is None or name in source.definitions:
                break
            module, _, name = source.imports.get(name, "").rpartition(".")
            source = load(module)
        return (source, source.definitions[name]) if source and name in source.definitions else None


@functools.cache
def load(module: str) -> ModuleSource | None:
    """Read a module's file, importing nothing; None if there is no Python file for it."""
    path = _file(module)
    return ModuleSource(module, path) if path else None


def installed(module: str) -> bool:
    """Whether a module is imported already, or its top-level package could be."""
    return module in sys.modules or _spec(module.partition(".")[0]) is not None


def _file(module: str) -> Path | None:
    loaded = getattr(sys.modules.get(module), "__file__", None)
    top, *rest = module.split(".")
    # Only a top-level name: for a dotted one find_spec would import the packages above it.
    spec = None if loaded else _spec(top)
    if spec and rest:
        folders = [Path(folder, *rest) for folder in spec.submodule_search_locations or ()]
        paths = [path for f in folders for path in (f.with_suffix(".py"), f / "__init__.py")]
    else:
        paths = [Path(loaded or (spec and spec.origin) or "")]
    return next((path for path in paths if path.suffix == ".py" and path.is_file()), None)


def _spec(top: str) -> importlib.machinery.ModuleSpec | None:
    try:
        return importlib.util.find_spec(top)
    except (ImportError, ValueError):  # ValueError: "" or a module that has no spec
        return None


def _flat(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements of a module, also those below `if TYPE_CHECKING:` and `try:`."""
    for statement in body:
        if isinstance(statement, (ast.If, ast.Try)):
            yield from _flat([*statement.body, *statement.orelse])
        else:
            yield statement


def annotated_type(annotation: ast.expr, source: ModuleSource) -> Any:
    """Evaluate an annotation with the names of its file that are plain types, others as `Any`."""
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        annotation = ast.parse(annotation.value, mode="eval").body
    code = compile(ast.Expression(annotation), "<annotation>", "eval")
    try:
        return eval(code, {"__builtins__": {}}, _Names(source))
    except Exception:  # an attribute or subscript of something that is only known as `Any`
        return Any


class _Names(Mapping[str, Any]):
    """The names an annotation may use, looked up in its file."""

    def __init__(self, source: ModuleSource) -> None:
        self._source = source

    def __getitem__(self, name: str) -> Any:
        local = name in self._source.definitions
        dotted = "" if local else self._source.imports.get(name, f"builtins.{name}")
        module, _, attribute = dotted.rpartition(".")
        if dotted in _VOCABULARY:
            return importlib.import_module(dotted)
        if module in _VOCABULARY:
            value = getattr(importlib.import_module(module), attribute, Any)
            return value if module != "builtins" or isinstance(value, type) else Any
        source, node = self._source.find(name) or (self._source, None)
        alias = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
        return annotated_type(alias, source) if alias else Any

    def __iter__(self) -> Iterator[str]:
        return iter(self._source.definitions)

    def __len__(self) -> int:
        return len(self._source.definitions)
