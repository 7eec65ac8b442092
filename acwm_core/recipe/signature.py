"""What a constructor takes, read from its source: a recipe is checked without importing it."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from acwm_core.recipe.source import ModuleSource, annotated_type, installed, load

_PLAIN_BASES = {"abc.ABC", "object", "torch.nn.Module", "typing.Generic", "typing.Protocol"}
"""Base classes whose constructors take nothing that a recipe could set."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of a constructor.

    Attributes:
        name: its name.
        annotation: its type as written, if any.
        value: its default as written; None if it has none and so is required.
        source: the file in which it stands.
    """

    name: str
    annotation: ast.expr | None
    value: ast.expr | None
    source: ModuleSource

    @property
    def type(self) -> Any:
        """The type as a Python object; `Any` as far as it cannot be told without importing."""
        return annotated_type(self.annotation, self.source) if self.annotation else Any

    @property
    def default(self) -> Any:
        """The default if it is written as a literal or names a constant, else `...`."""
        value = self.value
        if isinstance(value, ast.Name) and (found := self.source.find(value.id)):
            value = getattr(found[1], "value", None)
        try:
            return ast.literal_eval(value) if value else ...
        except ValueError:
            return ...


@dataclass(frozen=True)
class Signature:
    """The named parameters of a class or function.

    Attributes:
        owner: the name of the class or function.
        parameters: what it takes by keyword, in order.
        open: it also takes parameters that could not be read.
    """

    owner: str
    parameters: Mapping[str, Parameter]
    open: bool = False


@functools.cache
def signature(target: str) -> Signature | None:
    """Read the signature of ``"package.module:Name"``; None if there is no such thing.

    A target without a readable file (compiled, or defined in a notebook) has an open signature.
    """
    module, _, name = target.partition(":")
    source = load(module)
    if source is None:
        return Signature(name, {}, open=True) if installed(module) else None
    found = source.find(name)
    if found is None:
        return None
    source, node = found
    if isinstance(node, ast.ClassDef):
        return _constructor(node, source) or Signature(name, {})
    if isinstance(node, ast.FunctionDef):
        return Signature(name, _arguments(node, source), open=node.args.kwarg is not None)
    return Signature(name, {}, open=True)


def _constructor(node: ast.ClassDef, source: ModuleSource) -> Signature | None:
    """Of a class; None if neither it nor a base defines one."""
    decorators = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    if any(source.dotted(d) == "dataclasses.dataclass" for d in decorators):
        base = _inherited(node, source) or Signature("", {})
        fields = {field.name: field for field in _fields(node, source)}
        return Signature(node.name, {**base.parameters, **fields}, base.open)
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            own = _arguments(item, source, skip=1)
            if item.args.kwarg is None:
                return Signature(node.name, own)
            base = _inherited(node, source) or Signature("", {}, open=True)
            return Signature(node.name, {**base.parameters, **own}, base.open)
    base = _inherited(node, source)
    return base and Signature(node.name, base.parameters, base.open)


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
    """Parameters that can be given by keyword."""
    arguments = node.args
    positional = [*arguments.posonlyargs, *arguments.args]
    padding = [None] * (len(positional) - len(arguments.defaults))
    given = [*zip(positional, [*padding, *arguments.defaults], strict=True)][skip:]
    keyword = [pair for pair in given if pair[0] not in arguments.posonlyargs]
    keyword += zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    return {a.arg: Parameter(a.arg, a.annotation, value, source) for a, value in keyword}


def _fields(node: ast.ClassDef, source: ModuleSource) -> Iterator[Parameter]:
    """Fields of a dataclass that its constructor takes."""
    for item in node.body:
        if not isinstance(item, ast.AnnAssign) or not isinstance(item.target, ast.Name):
            continue
        value = item.value
        if source.dotted(item.annotation) == "typing.ClassVar":
            continue
        if isinstance(value, ast.Call) and source.dotted(value.func) == "dataclasses.field":
            options = {keyword.arg: keyword.value for keyword in value.keywords}
            if "init" in options and ast.unparse(options["init"]) == "False":
                continue
            value = options.get("default", options.get("default_factory"))
        yield Parameter(item.target.id, item.annotation, value, source)
