"""The states that a model predicts, as an observation without pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.physics import Observation
from acwm_core.errors import RecipeError


class NotPredicted(RecipeError):
    """A task looks at something that the model does not predict."""


class PredictedStates(Mapping[str, NDArray[Any]]):
    """Predicted fields of the state, `[T, …]` each.

    Raises:
        NotPredicted: for any other field.
    """

    def __init__(self, fields: Mapping[str, NDArray[Any]]) -> None:
        self._fields = fields

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._fields:
            raise NotPredicted(
                f"the model predicts {', '.join(self._fields)}, but the task needs {name}: set "
                "cost.read=pictures"
            )
        return self._fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)


class _NoMasks:
    """In place of the masks of T frames, of which it knows the number only."""

    def __init__(self, frames: int) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return self._frames

    def _refuse(self, *_: object) -> Any:
        raise NotPredicted("the task needs masks, which no model predicts: set cost.read=pictures")

    __getattr__ = __getitem__ = __iter__ = __array__ = __eq__ = __hash__ = _refuse


def predicted_observation(states: Tensor, shapes: Mapping[str, tuple[int, ...]]) -> Observation:
    """What is known of T frames from their states `[T, S]`, the fields side by side."""
    parts = states.split([math.prod(shape) for shape in shapes.values()], 1)
    fields = {
        name: np.asarray(part.reshape(-1, *shape))
        for part, (name, shape) in zip(parts, shapes.items(), strict=True)
    }
    return observation_of(fields, len(states))


def observation_of(fields: Mapping[str, NDArray[Any]], frames: int) -> Observation:
    """What is known of so many frames T from fields of their states alone, `[T, …]` each."""
    return Observation(cast(Any, _NoMasks(frames)), PredictedStates(fields))
