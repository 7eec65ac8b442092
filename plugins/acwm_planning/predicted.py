"""The states that a model predicts, as an observation without pictures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
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


class LazyFields(Mapping[str, NDArray[Any]]):
    """Fields that are predicted when they are asked for, `[T, …]` each.

    Args:
        names: of the fields.
        predict: predicts the field of this name.
    """

    def __init__(self, names: Collection[str], predict: Callable[[str], Tensor]) -> None:
        self._names, self._predict = names, predict

    def __getitem__(self, name: str) -> NDArray[Any]:
        return np.asarray(self._predict(name))

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def observation_of(fields: Mapping[str, NDArray[Any]], frames: int) -> Observation:
    """What is known of so many frames T from fields of their states alone, `[T, …]` each."""
    return Observation(cast(Any, _NoMasks(frames)), PredictedStates(fields))
