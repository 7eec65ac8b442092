"""The card of an environment: its actions, states and factors, readable without a simulator."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, cast

from acwm_core.episode import Factor
from acwm_core.errors import ShapeError


@dataclass(frozen=True)
class ActionSpec:
    """What the numbers of an action mean.

    Attributes:
        names: one per dimension, e.g. ``("target_x", "target_y")``.
        units: one per dimension, e.g. ``("m", "m")``; ``""`` for a pure number.
        low: lower bounds in these units; models normalise actions to [-1, 1] by the bounds.
        high: upper bounds.
        kind: what an action commands.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    kind: Literal["absolute", "delta", "torque"]

    def __post_init__(self) -> None:
        lengths = {len(self.names), len(self.units), len(self.low), len(self.high)}
        if len(lengths) != 1:
            raise ShapeError("an ActionSpec needs a name, a unit, a low and a high per dimension")
        bounds = zip(self.low, self.high, strict=True)
        if not all(-math.inf < low < high < math.inf for low, high in bounds):
            raise ShapeError("every lower action bound must lie below its upper bound")

    @property
    def size(self) -> int:
        """Number of action dimensions A."""
        return len(self.names)


@dataclass(frozen=True)
class StateField:
    """One named array of ground truth, recorded in every frame.

    Attributes:
        name: key in `Episode.states`.
        shape: shape of one frame's value.
        unit: e.g. ``"m"``; ``""`` for none.
        description: one phrase, saying the frame of reference where there is one.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    description: str


@dataclass(frozen=True)
class EnvironmentCard:
    """What a user, a dataset and a model need to know of an environment without running it.

    Attributes:
        name: registered name.
        summary: one sentence.
        action: meaning and bounds of the action.
        frame_size: default ``(H, W)``.
        fps: frames, and so actions, per second.
        horizon: frames of an episode, T.
        factors: everything that can vary.
        ood_shifts: names of the factors that `ood_test` shifts, one per episode in turn.
        state: the ground-truth arrays.
        instances: names of the mask ids, in order; id 0 is the background.
        engine: the simulator, e.g. ``"MuJoCo"``.
        episodes: size of the full benchmark per split.
        variants: other registered names that are variants of this environment.
        citation: where the task comes from.
    """

    name: str
    summary: str
    action: ActionSpec
    frame_size: tuple[int, int]
    fps: int
    horizon: int
    factors: tuple[Factor, ...]
    ood_shifts: tuple[str, ...]
    state: tuple[StateField, ...]
    instances: tuple[str, ...]
    engine: str
    episodes: Mapping[str, int] = field(default_factory=dict[str, int])
    variants: tuple[str, ...] = ()
    citation: str = ""

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict, the inverse of `from_dict`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> EnvironmentCard:
        """Read what `to_dict` wrote, also after a round trip through JSON or YAML."""
        values = {name: _tuples(value) for name, value in fields.items()}
        values["action"] = ActionSpec(**_fields(fields["action"]))
        values["factors"] = tuple(Factor(**_fields(f)) for f in fields["factors"])
        values["state"] = tuple(StateField(**_fields(f)) for f in fields["state"])
        values["episodes"] = dict(fields.get("episodes", {}))
        return cls(**values)


def _fields(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuples(value) for name, value in values.items()}


def _tuples(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(item) for item in cast(Iterable[Any], value))
    return value
