"""What a constructor takes, and what it passes on."""

from __future__ import annotations

import inspect
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from lightning.pytorch import Trainer

from acwm_core.recipe.signature import REQUIRED, Parameter, signature
from acwm_core.training.config import TRAINER_FLAGS

if TYPE_CHECKING:
    from nowhere import Thing

Sizes = tuple[int, ...]


class Root(torch.nn.Module):
    def __init__(self, size: int, speed: float = 1.0):
        super().__init__()


class More(Root):
    def __init__(self, *, colour: Literal["red", "blue"] = "red", size: int = 3, **others):
        super().__init__(size, **others)


class Anything(torch.nn.Module):
    def __init__(self, sizes: Sizes | None = None, **options: Any):
        super().__init__()


class Untyped:
    def __init__(self, thing: Thing, size: int = 1): ...


@dataclass(frozen=True)
class Base:
    kind: ClassVar[str] = "k"
    a: int
    _: KW_ONLY
    b: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Config(Base):
    c: float = field(default=2.0)
    d: int = field(init=False, default=0)


def make(a, /, b: int, *args, c: str = "x", **others): ...


def test_what_is_passed_on_comes_first_and_is_overridden():
    class Same(More): ...

    for kind in (More, Same):
        found = signature(kind)
        assert [*found.parameters.items()] == [
            ("size", Parameter(int, 3)),
            ("speed", Parameter(float, 1.0)),
            ("colour", Parameter(Literal["red", "blue"], "red")),
        ]
        assert (found.owner, found.open) == (kind.__name__, False)


def test_what_nobody_takes_up_leaves_it_open():
    found = signature(Anything)
    assert found.parameters == {"sizes": Parameter(tuple[int, ...] | None, None)}
    assert found.open
    assert signature(torch.nn.Identity).open  # it takes whatever it is given
    assert not signature(torch.nn.Module).open


def test_functions_and_dataclasses():
    found = signature(make)
    assert found.parameters == {"b": Parameter(int, REQUIRED), "c": Parameter(str, "x")}
    assert found.open
    found = signature(Config)
    assert [*found.parameters] == ["a", "c", "b"]
    assert found.parameters["c"] == Parameter(float, 2.0)
    assert found.parameters["a"] == Parameter(int, REQUIRED)


def test_types_that_cannot_be_resolved_accept_anything():
    found = signature(Untyped)
    assert found.parameters == {"thing": Parameter(Any, REQUIRED), "size": Parameter(Any, 1)}


def test_the_flags_of_the_trainer_are_lightnings():
    assert [*TRAINER_FLAGS] == [*inspect.signature(Trainer).parameters]
