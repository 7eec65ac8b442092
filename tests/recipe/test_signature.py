"""What a constructor takes and passes on, and values against types, strictly."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import pytest
import torch
from lightning.pytorch import Trainer

from acwm_core.errors import RecipeError
from acwm_core.recipe.signature import REQUIRED, Parameter, signature
from acwm_core.recipe.types import checked, describe
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


@pytest.mark.parametrize(
    ("value", "expected", "result"),
    [
        (5, float, 5.0),
        ([1, 2], tuple[int, int], (1, 2)),
        ([1], Sequence[int], [1]),
        ("runs/x", Path, Path("runs/x")),
        ("a", Literal["a", "b"], "a"),
        (None, int | None, None),
        ({"class_path": "x.Y"}, str | Any, {"class_path": "x.Y"}),
        ({"a": 1}, dict[str, int], {"a": 1}),
    ],
)
def test_values_take_their_type(value, expected, result):
    taken = checked("x", value, expected)
    assert taken == result
    assert type(taken) is type(result)


@pytest.mark.parametrize(
    ("value", "expected", "message"),
    [
        ("5", int, "model.x=5: expected int"),
        (1.5, int, "model.x=1.5: expected int"),
        (True, int, "model.x=true: expected int"),
        (1, bool, "model.x=1: expected bool"),
        (None, str, "model.x=null: expected str"),
        ([1, 2, 3], tuple[int, int], "model.x=[1, 2, 3]: expected [int, int]"),
        ("x", tuple[int, ...] | None, "model.x=x: expected [int, …] or null"),
        ("cleen", Literal["clean", "velocity"], "did you mean 'clean'?"),
        ("q", Literal["clean", "velocity"] | None, "expected 'clean' or 'velocity' or null"),
    ],
)
def test_wrong_types_are_refused(value, expected, message):
    with pytest.raises(RecipeError) as error:
        checked("model.x", value, expected)
    assert message in str(error.value)


def test_types_without_a_schema_are_left_to_the_constructor():
    class Own: ...

    assert checked("x", 3, Own) == 3


def test_descriptions():
    assert describe(dict[str, list[int]] | None) == "dict[str, [int, …]] or null"
    assert describe(Callable) == "Callable"
