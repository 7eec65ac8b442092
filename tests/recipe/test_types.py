"""Values against types, strictly."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

from acwm_core.errors import RecipeError
from acwm_core.recipe.types import checked, describe


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
def test_values_take_their_type(value: Any, expected: Any, result: Any) -> None:
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
def test_wrong_types_are_refused(value: Any, expected: Any, message: str) -> None:
    with pytest.raises(RecipeError) as error:
        checked("model.x", value, expected)
    assert message in str(error.value)


def test_types_without_a_schema_are_left_to_the_constructor() -> None:
    class Own: ...

    assert checked("x", 3, Own) == 3


def test_descriptions() -> None:
    assert describe(dict[str, list[int]] | None) == "dict[str, [int, …]] or null"
    assert describe(Callable) == "Callable"
