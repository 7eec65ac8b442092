"""Signatures read from source, against what Python itself says of the imported object."""

import inspect
import textwrap
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

import pytest

from acwm_core.plugins import COMPONENT_KINDS, catalog
from acwm_core.recipe.check import SECTIONS
from acwm_core.recipe.signature import signature

PARTS = {
    component.target
    for kind in COMPONENT_KINDS
    for component in catalog().registry(kind)
    if component.distribution and kind != "task"  # an object, which takes no parameters
}


@pytest.mark.parametrize("target", sorted({*SECTIONS.values(), *PARTS}))
def test_reads_what_python_sees(target: str) -> None:
    reading = signature(target)
    assert reading is not None
    seen = inspect.signature(resolve_name(target)).parameters
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    if not any(parameter.kind in kinds for parameter in seen.values()):
        assert [*reading.parameters] == [*seen]
        assert not reading.open
    for name, parameter in reading.parameters.items():
        if name in seen:
            assert (parameter.value is None) == (seen[name].default is inspect.Parameter.empty)
            if parameter.default is not ...:
                assert parameter.default == seen[name].default


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An importable package whose import fails: its signatures must come from its text."""
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / f"plugin_{tmp_path.name.replace('-', '_')}"
    folder.mkdir()
    (folder / "__init__.py").write_text("raise RuntimeError('imported')\n")
    return folder


def write(package: Path, module: str, text: str) -> str:
    (package / f"{module}.py").write_text(textwrap.dedent(text))
    return f"{package.name}.{module}"


def names(target: str) -> list[str]:
    reading = signature(target)
    assert reading is not None
    return [*reading.parameters]


def types(target: str) -> dict[str, Any]:
    reading = signature(target)
    assert reading is not None
    return {name: parameter.type for name, parameter in reading.parameters.items()}


def test_constructors_are_inherited_across_files(package: Path) -> None:
    write(package, "base", "class Base:\n    def __init__(self, size: int, speed: float = 1): ...")
    module = write(
        package,
        "components",
        """
        import torch.nn
        from .base import Base as Root

        class Same(torch.nn.Module, Root): ...

        class More(Root):
            def __init__(self, *, colour: str = "red", size: int = 3, **kwargs):
                super().__init__(size, **kwargs)

        class Alone(torch.nn.Module): ...
        """,
    )
    assert names(f"{module}:Same") == ["size", "speed"]
    assert names(f"{module}:More") == ["size", "speed", "colour"]
    more = signature(f"{module}:More")
    assert more is not None
    assert (more.open, more.parameters["size"].default) == (False, 3)
    assert names(f"{module}:Alone") == []


def test_what_cannot_be_read_is_open(package: Path) -> None:
    module = write(
        package,
        "components",
        """
        import functools
        from nowhere import Unknown

        class Child(Unknown): ...
        class Anything:
            def __init__(self, **kwargs): ...
        made = functools.partial(Child)
        """,
    )
    for name in ("Child", "Anything", "made"):
        reading = signature(f"{module}:{name}")
        assert reading is not None
        assert reading.open
    assert signature(f"{module}:Missing") is None
    assert signature("no_such_package.components:Child") is None


def test_functions_and_dataclasses(package: Path) -> None:
    module = write(
        package,
        "components",
        """
        from dataclasses import dataclass, field
        from typing import ClassVar

        WIDTH = 64

        def make(a, /, b: int, *args, c: str = "x", d=WIDTH): ...

        @dataclass
        class Base:
            kind: ClassVar[str] = "k"
            a: int
            b: list[int] = field(default_factory=list)

        @dataclass(frozen=True)
        class Config(Base):
            c: float = field(default=2.0)
            d: int = field(init=False, default=0)
        """,
    )
    assert names(f"{module}:make") == ["b", "c", "d"]
    reading = signature(f"{module}:make")
    assert reading is not None
    assert reading.parameters["d"].default == 64
    assert names(f"{module}:Config") == ["a", "b", "c"]
    config = signature(f"{module}:Config")
    assert config is not None
    assert config.parameters["a"].value is None
    assert config.parameters["b"].default is ...
    assert config.parameters["c"].default == 2.0


def test_types_follow_aliases_and_leave_the_unknown_open(package: Path) -> None:
    write(package, "words", "from typing import Literal, Union\nMode = Literal['a', 'b']\n")
    module = write(
        package,
        "components",
        """
        from __future__ import annotations
        import typing as t
        import numpy as np
        from collections.abc import Sequence
        from .words import Mode

        if t.TYPE_CHECKING:
            from nowhere import Thing

        Sizes = tuple[int, ...]

        class Component:
            def __init__(
                self, mode: Mode, sizes: Sizes | None, many: Sequence[float], text: "str",
                array: np.ndarray, thing: Thing, either: t.Optional[t.Union[int, Thing]], bare=1,
            ): ...
        """,
    )
    read = types(f"{module}:Component")
    assert read["mode"] == Literal["a", "b"]
    assert read["sizes"] == tuple[int, ...] | None
    assert read["text"] is str
    assert {read["array"], read["thing"], read["bare"]} == {Any}
    assert read["either"] == int | Any | None
