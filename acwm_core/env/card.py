"""The card of an environment: its actions, states and factors, readable without a simulator."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera, Vec3
from acwm_core.env.episode import Episode, Factor, plain_unit
from acwm_core.env.state_field import StateField as StateField
from acwm_core.env.state_field import check_scene
from acwm_core.env.states import transform
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import ShapeError, expect
from acwm_core.files import plain_name

ActionKind = Literal["absolute", "delta", "velocity", "torque"]
"""What an action commands: a position, a change of position, a speed, or a force or torque."""

SAME_RATE = 0.01
"""Relative difference of two rates up to which they are one: 29.97 and 30 frames per second."""


SCENE = ("camera", "light")
"""What a card says of the scene beside its fields; cards from before there was such have none."""


@dataclass(frozen=True)
class ActionSpec:
    """The meaning, units and bounds of the action dimensions.

    Attributes:
        names: one per dimension, e.g. ``("target_x", "target_y")``.
        units: one per dimension, e.g. ``("m", "m")``; ``""`` for a pure number.
        low: lower bounds in these units; models use the bounds to normalise actions to [-1, 1].
        high: upper bounds.
        kind: what an action commands: ``"absolute"``, ``"delta"``, ``"velocity"`` or ``"torque"``
            (also forces).

    Raises:
        ShapeError: the lengths differ, or a lower bound is not below its upper bound.
        ShapeError: the kind is unknown.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    kind: ActionKind

    def __post_init__(self) -> None:
        object.__setattr__(self, "units", tuple(map(plain_unit, self.units)))
        lengths = {len(self.names), len(self.units), len(self.low), len(self.high)}
        if len(lengths) != 1:
            raise ShapeError("an ActionSpec needs a name, a unit, a low and a high per dimension")
        bounds = zip(self.low, self.high, strict=True)
        if not all(-math.inf < low < high < math.inf for low, high in bounds):
            raise ShapeError("every lower action bound must lie below its upper bound, both finite")
        if self.kind not in get_args(ActionKind):
            known = ", ".join(get_args(ActionKind))
            raise ShapeError(f"the kind of an action is one of {known}, not {self.kind!r}")

    @property
    def size(self) -> int:
        """Number of action dimensions A."""
        return len(self.names)


@dataclass(frozen=True)
class EnvironmentCard:
    """What users, datasets and models need to know about an environment without running it.

    Attributes:
        name: registered name.
        summary: one sentence.
        action: meaning and bounds of the action.
        frame_size: default ``(H, W)``.
        fps: frames, and so actions, per second; a whole rate is an integer. See `exact_rate`.
        horizon: number of frames of an episode, T.
        factors: the factors of variation.
        ood_shifts: names of the factors that `ood_test` shifts, one per episode in turn.
        state: the ground-truth arrays.
        instances: names of the mask ids, in order; id 0 is the background.
        engine: the simulator, e.g. ``"MuJoCo"``.
        episodes: number of episodes per split in the full benchmark.
        variants: other registered names that are variants of this environment.
        citation: source of the task.
        views: names of the cameras, from left to right, if a frame shows several of equal width.
        symmetries: all that the environment has, see `acwm_core.env.symmetry.group`; without those
            that frames of this size cannot show.
        camera: where positions are in the picture, at nominal factors. None if that is unknown.
        light: direction in the world to the light, if shadows tell something of where things are.

    Raises:
        ShapeError: a symmetry takes another number of actions.
        ShapeError: a field of the state names another field or an instance that is not there.
        ShapeError: there is a camera, although frames show several views.
    """

    name: str
    summary: str
    action: ActionSpec
    frame_size: tuple[int, int]
    fps: float
    horizon: int
    factors: tuple[Factor, ...]
    ood_shifts: tuple[str, ...]
    state: tuple[StateField, ...]
    instances: tuple[str, ...]
    engine: str
    episodes: Mapping[str, int] = field(default_factory=dict[str, int])
    variants: tuple[str, ...] = ()
    citation: str = ""
    views: tuple[str, ...] = ()
    symmetries: tuple[Symmetry, ...] = ()
    camera: Camera | None = None
    light: Vec3 | None = None

    def __post_init__(self) -> None:
        check_scene(self.state, self.instances)
        if self.views and self.camera:
            raise ShapeError(
                f"frames of {self.name} show several views, which no single camera sees"
            )
        if self.light is not None and not (
            len(self.light) == 3 and 0 < math.hypot(*self.light) < math.inf
        ):
            raise ShapeError(f"the light of {self.name} is a direction, not {list(self.light)}")
        object.__setattr__(self, "fps", plain_rate(self.fps))
        for symmetry in self.symmetries:
            if len(symmetry.actions) != self.action.size:
                raise ShapeError(
                    f"the symmetry {symmetry.name!r} of {self.name} takes "
                    f"{len(symmetry.actions)} actions, not {self.action.size}"
                )
        kept = tuple(symmetry for symmetry in self.symmetries if symmetry.keeps(self.frame_size))
        object.__setattr__(self, "symmetries", kept)

    @property
    def view_names(self) -> tuple[str, ...]:
        """The views without what all their names begin with, up to a dot or a slash."""
        parts = [re.split(r"(?<=[./])", view) for view in self.views]
        common = 0
        while len({part[common] for part in parts}) == 1 and min(map(len, parts)) > common + 1:
            common += 1
        return tuple("".join(part[common:]) for part in parts)

    @property
    def fields(self) -> dict[str, StateField]:
        """The fields of the state by their names."""
        return {field.name: field for field in self.state}

    @property
    def recorded(self) -> EnvironmentCard:
        """The card without what says what could be made of recorded data: symmetries and scene."""
        plain = (StateField(f.name, f.shape, f.unit, f.description) for f in self.state)
        return replace(self, state=tuple(plain), symmetries=(), camera=None, light=None)

    def completed_by(self, other: EnvironmentCard) -> EnvironmentCard:
        """The card with the symmetries and what else `other` says of the scene, if it says nothing.

        Both are cards of the same recorded data.
        """
        own = {field.name: field for field in self.recorded.state}
        fields = other.fields
        state = (fields.get(f.name, f) if f == own[f.name] else f for f in self.state)
        return replace(
            self,
            state=tuple(state),
            symmetries=self.symmetries or other.symmetries,
            camera=self.camera or other.camera,
            light=self.light or other.light,
        )

    def contradictions(self, other: EnvironmentCard) -> list[str]:
        """Declarations of the scene that differ, e.g. ``["camera", "state yaw"]``."""
        mine, theirs = self.completed_by(other), other.completed_by(self)
        differences = [name for name in SCENE if getattr(mine, name) != getattr(theirs, name)]
        pairs = zip(mine.state, theirs.state, strict=False)
        return differences + [f"state {a.name}" for a, b in pairs if a != b and a.name == b.name]

    def transformed(self, symmetry: Symmetry, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """The values `[T, …]` of a state field after a symmetry: as that says, or as the kind does.

        Raises:
            ShapeError: neither says how the field is transformed.
        """
        if name in symmetry.states or name in symmetry.headings:
            return symmetry.of_states(name, values)
        return transform(self.fields[name], values, symmetry, self.camera)

    def transforms(self, symmetry: Symmetry, name: str) -> bool:
        """Whether it is known how a symmetry transforms a state field."""
        try:
            self.transformed(symmetry, name, np.zeros((1, *self.fields[name].shape)))
        except ShapeError:
            return False
        return True

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict, the inverse of `from_dict`."""
        values = {**asdict(self), "state": [field.to_dict() for field in self.state]}
        newer = {name for name in ("views", "symmetries", *SCENE) if not values[name]}
        return {name: value for name, value in values.items() if name not in newer}

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> EnvironmentCard:
        """The inverse of `to_dict`, also after a round trip through JSON or YAML.

        Raises:
            ValueError: its name or that of a factor, which become names of folders and files, is
                no plain word.
        """
        plain_name(fields["name"], "an environment")
        for factor in fields["factors"]:
            plain_name(factor["name"], "a factor")
        values = {name: _tuples(value) for name, value in fields.items()}
        values["action"] = ActionSpec(**_fields(fields["action"]))
        values["factors"] = tuple(Factor(**_fields(f)) for f in fields["factors"])
        values["state"] = tuple(StateField(**_fields(f)) for f in fields["state"])
        values["episodes"] = dict(fields.get("episodes", {}))
        symmetries = fields.get("symmetries", ())
        values["symmetries"] = tuple(map(Symmetry.from_dict, symmetries))
        if camera := fields.get("camera"):
            values["camera"] = Camera.from_dict(camera)
        return cls(**values)


def exact_rate(fps: float | Fraction) -> Fraction:
    """The rate that a card's `fps` stands for, e.g. 30000/1001 for 29.97002997…"""
    return Fraction(fps).limit_denominator(100_000)


def plain_rate(fps: float | Fraction | str) -> float:
    """A rate as a card has it: an integer if it is whole, else a float.

    Args:
        fps: frames per second; a text may be ``30000/1001``.

    Raises:
        ShapeError: it is no positive number.
    """
    try:
        rate = exact_rate(Fraction(fps if isinstance(fps, str | Fraction) else float(fps)))
    except (ValueError, OverflowError, ZeroDivisionError, TypeError):
        rate = Fraction(0)
    if rate <= 0:
        raise ShapeError(f"{fps!r} is not a rate: give frames per second, such as 30 or 30000/1001")
    return rate.numerator if rate.denominator == 1 else float(rate)


def meaning_differences(
    ours: EnvironmentCard, theirs: EnvironmentCard
) -> tuple[list[str], list[str]]:
    """How time and actions of two cards differ in meaning; bounds may differ.

    Returns:
        Phrases about each, such as ``["30 frames/s"]`` and ``["10 frames/s"]``; empty if both mean
        the same.
    """
    pairs = list[tuple[str, str]]()
    a, b = ours.action, theirs.action
    if abs(ours.fps / theirs.fps - 1) > SAME_RATE:
        pairs.append((f"{ours.fps:g} frames/s", f"{theirs.fps:g} frames/s"))
    if a.names != b.names:
        order = " in this order" if sorted(a.names) == sorted(b.names) else ""
        pairs.append((f"the actions {', '.join(a.names)}{order}", ", ".join(b.names)))
    elif a.units != b.units:
        axes = zip(a.names, a.units, b.units, strict=True)
        changes = [
            (f"{n} in {u or 'no unit'}", f"{n} in {v or 'no unit'}") for n, u, v in axes if u != v
        ]
        pairs.append((", ".join(f for f, _ in changes), ", ".join(f for _, f in changes)))
    if a.kind != b.kind:
        pairs.append((f"actions of the kind {a.kind}", f"the kind {b.kind}"))
    return [side for side, _ in pairs], [side for _, side in pairs]


def check_episode(episode: Episode, card: EnvironmentCard) -> None:
    """Check the arrays of an episode against the environment card.

    Raises:
        DataError: a shape, type, id or range is wrong; the message says which.
    """
    frames, (height, width) = len(episode.video), card.frame_size
    shape, names = episode.video.shape[1:], len(card.instances)
    expect(shape == (height, width, 3), f"frames are {shape}, the card says {height}×{width}")
    masks = episode.masks
    expect(masks.shape == (frames, height, width), f"masks are {masks.shape}")
    expect(masks.dtype == np.uint8, f"masks are {masks.dtype}, not uint8")
    expect(masks.max(initial=0) < names, f"mask id {masks.max(initial=0)} has no name")
    _check_actions(episode.actions, card.action)
    fields = {field.name: field.shape for field in card.state}
    expect(set(episode.states) == set(fields), f"the state fields are {sorted(episode.states)}")
    for name, values in episode.states.items():
        expect(values.shape[1:] == fields[name], f"state {name} is {values.shape[1:]}")
        expect(values.dtype.kind in "fiub", f"state {name} is {values.dtype}")
        expect(np.all(np.isfinite(values)), f"state {name} is not finite")
    contacts = episode.contacts
    expect(contacts.ndim == 2 and contacts.shape[1] == 3, f"contacts are {contacts.shape}")
    low, high = contacts.min(initial=0), contacts[:, 1:].max(initial=0)
    inside = low >= 0 and high < names and contacts[:, 0].max(initial=0) < frames
    expect(inside, "a contact refers to a frame or an instance that does not exist")


def _check_actions(actions: NDArray[np.float32], spec: ActionSpec) -> None:
    expect(actions.dtype == np.float32, f"actions are {actions.dtype}")
    expect(actions.shape[1:] == (spec.size,), f"actions are {actions.shape}")
    expect(np.all(np.isfinite(actions)), "an action is not finite")
    beyond = out_of_bounds(actions[:-1], spec)
    expect(not beyond, beyond)


def out_of_bounds(actions: NDArray[Any], spec: ActionSpec) -> str:
    """Which of the actions ``[N, A]`` lies beyond which bound, for a message; empty if none."""
    taken, low, high = actions.astype(np.float64), np.array(spec.low), np.array(spec.high)
    slack = 1e-6 * (high - low)  # float32 rounding of a bound is no violation
    outside = (taken < low - slack) | (taken > high + slack)
    if not outside.any():
        return ""
    row, column = np.argwhere(outside)[0]
    value, bounds = taken[row, column], f"[{low[column]:g}, {high[column]:g}]"
    return f"the action {spec.names[column]} is {value:g} in row {row}, out of its bounds {bounds}"


def _fields(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _tuples(value) for name, value in values.items()}


def _tuples(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(item) for item in cast(Iterable[Any], value))
    return value
