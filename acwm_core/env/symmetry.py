"""Symmetries of an environment: transformations that turn each of its episodes into another one."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import ShapeError

Axes = tuple[int, ...]
"""A signed permutation of the values along an axis: for each new value, the number of the old one,
counted from 1, and negative if the sign changes. ``(-2, 1)`` makes (-y, x) of (x, y)."""


@dataclass(frozen=True)
class Symmetry:
    """A transformation of frames and actions under which the environment stays the same.

    From a transformed start, transformed actions lead to the transformed video. Light and floor
    need not follow: only where everything is must match.

    Attributes:
        actions: how it transforms an action.
        mirrored: whether frames are mirrored, left to right.
        quarter_turns: by how many quarter turns, 0 to 3, they are turned after that,
            counter-clockwise.
        states: how it transforms the last axis of fields of the state whose kind does not tell, as
            of values (`acwm_core.env.states.transform`); those that do not transform so simply are
            left out.
        headings: fields of the state that hold directions in the plane of the frame, in rad and
            counter-clockwise from the right. They turn with it.
        repainted: instances whose colours change, and change back when it is done twice, as those
            of a cloth whose sides change places.

    Raises:
        ShapeError: it is none, or the identity of frames.
    """

    actions: Axes
    mirrored: bool = False
    quarter_turns: int = 0
    states: Mapping[str, Axes] = field(default_factory=dict[str, Axes])
    headings: tuple[str, ...] = ()
    repainted: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.quarter_turns not in range(4) or not (self.mirrored or self.quarter_turns):
            raise ShapeError("a symmetry mirrors frames, or turns them by 1 to 3 quarter turns")
        for axes in (self.actions, *self.states.values()):
            if sorted(map(abs, axes)) != list(range(1, len(axes) + 1)):
                raise ShapeError(
                    f"{list(axes)} is not a signed permutation: give the numbers 1 to {len(axes)}, "
                    "each once, with a minus where the sign changes"
                )

    @property
    def name(self) -> str:
        """A short name, e.g. ``"mirrored-turned90"``."""
        turned = f"turned{90 * self.quarter_turns}" if self.quarter_turns else ""
        return "-".join(filter(None, ("mirrored" if self.mirrored else "", turned)))

    @property
    def plane(self) -> NDArray[np.float64]:
        """[2, 2]; what it does to (x, y) in the plane of the frame, x to the right and y up."""
        turn = np.array([[0.0, -1.0], [1.0, 0.0]])
        mirror = np.diag([-1.0 if self.mirrored else 1.0, 1.0])
        return np.linalg.matrix_power(turn, self.quarter_turns) @ mirror

    def keeps(self, frame_size: tuple[int, int]) -> bool:
        """Whether transformed frames have the same size ``(H, W)``."""
        return self.quarter_turns % 2 == 0 or frame_size[0] == frame_size[1]

    def of_frames(self, frames: NDArray[Any]) -> NDArray[Any]:
        """The transformed frames of ``[…, H, W]``, a view."""
        mirrored = frames[..., ::-1] if self.mirrored else frames
        return np.rot90(mirrored, self.quarter_turns, axes=(-2, -1))

    def of_actions(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The transformed actions of ``[…, A]``."""
        return permuted(actions, self.actions)

    def of_states(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """The transformed values of a field of the state, ``[T, S]``, its axes side by side.

        Raises:
            ShapeError: it is not said how the field is transformed.
        """
        if name in self.headings:
            turned = (np.pi - values if self.mirrored else values) + self.quarter_turns * np.pi / 2
            return np.remainder(turned + np.pi, 2 * np.pi).astype(values.dtype) - np.pi
        if name not in self.states:
            raise ShapeError(f"the symmetry {self.name} does not say how it transforms {name}")
        axes = self.states[name]
        return permuted(values.reshape(len(values), -1, len(axes)), axes).reshape(values.shape)

    def after(self, first: Symmetry) -> Symmetry | None:
        """This symmetry after the `first` one; None if frames are then as they were.

        Raises:
            ShapeError: the frames are as they were, but not actions or states.
        """
        # A mirror image turns the other way.
        sign = -1 if self.mirrored else 1
        turns = (self.quarter_turns + sign * first.quarter_turns) % 4
        actions = _joined(self.actions, first.actions)
        states = {
            name: _joined(axes, first.states[name])
            for name, axes in self.states.items()
            if name in first.states
        }
        headings = tuple(name for name in self.headings if name in first.headings)
        mirrored = self.mirrored != first.mirrored
        if mirrored or turns:
            repainted = tuple(sorted(set(self.repainted) ^ set(first.repainted)))
            return Symmetry(actions, mirrored, turns, states, headings, repainted)
        if any(axes != tuple(range(1, len(axes) + 1)) for axes in (actions, *states.values())):
            raise ShapeError(
                f"{self.name} after {first.name} leaves frames as they are and changes actions or "
                "states"
            )
        return None

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Symmetry:
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON or YAML."""
        states = {name: tuple(axes) for name, axes in values.get("states", {}).items()}
        of_frames = {name: values[name] for name in ("mirrored", "quarter_turns") if name in values}
        names = {name: tuple(values.get(name, ())) for name in ("headings", "repainted")}
        return cls(tuple(values["actions"]), states=states, **names, **of_frames)


def permuted(values: NDArray[Any], axes: Axes) -> NDArray[Any]:
    """The last axis of `values` after a signed permutation."""
    signed = np.array(axes)
    return values[..., np.abs(signed) - 1] * np.sign(signed).astype(values.dtype)


def group(*generators: Symmetry) -> tuple[Symmetry, ...]:
    """All symmetries that follow from some, in a fixed order.

    Raises:
        ShapeError: two of them transform frames alike, but not actions or states.
    """
    by_name: dict[str, Symmetry] = {}
    new = list(generators)
    while new:
        for symmetry in new:
            if by_name.setdefault(symmetry.name, symmetry) != symmetry:
                raise ShapeError(
                    f"there are two symmetries {symmetry.name!r}: they do not form a group"
                )
        pairs = itertools.product(list(by_name.values()), repeat=2)
        products = [both for second, first in pairs if (both := second.after(first)) is not None]
        new = [symmetry for symmetry in products if by_name.get(symmetry.name) != symmetry]
    return tuple(by_name[name] for name in sorted(by_name))


def _joined(second: Axes, first: Axes) -> Axes:
    """The signed permutation `second` after `first`."""
    return tuple((1 if axis > 0 else -1) * first[abs(axis) - 1] for axis in second)
