"""A field of the state, and what its numbers are: places, orientations, whose, and in which grid.

What is declared here is what models, estimators, metrics and symmetries know of a scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, Literal, get_args

from acwm_core.env.camera import Vec3
from acwm_core.env.episode import plain_unit
from acwm_core.errors import ShapeError

Kind = Literal["value", "position", "vector", "angle", "quaternion", "presence", "curve", "surface"]
"""What numbers of the state are:

* ``value``: an amount or the angle of a robot's joint; anything else.
* ``position``: a place in the world, x, y(, z); with two numbers, on the plane z = `height`.
* ``vector``: a velocity or another vector of the world, x, y(, z).
* ``angle``: in rad; one number, or one per row.
* ``quaternion``: an orientation in the world, w, x, y, z.
* ``presence``: 1 for a row that exists, and 0.
* ``curve``, ``surface``: positions of the nodes of one body, in a grid `(n,)` or `(rows, columns)`.
  A curve may be counted from either end.
"""

BodySymmetry = Literal["none", "half_turn", "quarter_turn", "box", "cube"]
"""Rotations after which a body looks the same:

* ``half_turn``, ``quarter_turn``: for an angle, rotations by π or π/2.
* ``box``, ``cube``: for a quaternion, the 4 rotations of a box or the 24 of a cube.
"""

SYMMETRIES: Mapping[str, tuple[BodySymmetry, ...]] = {
    "angle": ("none", "half_turn", "quarter_turn"),
    "quaternion": ("none", "box", "cube"),
}
"""The symmetries that numbers of a kind can have."""

PLACES: tuple[Kind, ...] = ("position", "curve", "surface")
"""Kinds that are places in the world."""

_SIZES: Mapping[str, tuple[int, ...]] = {"quaternion": (4,), "position": (2, 3), "vector": (2, 3)}
_GRIDS: Mapping[str, int] = {"curve": 1, "surface": 2}


@dataclass(frozen=True)
class Part:
    """Numbers of one kind in a field.

    Attributes:
        kind: what they are.
        columns: which entries of the last axis; empty for all.
    """

    kind: Kind
    columns: tuple[int, ...] = ()


@dataclass(frozen=True)
class StateField:
    """One named array of ground truth, recorded in every frame.

    All but the first four are optional, and say what the numbers are; see `Kind`.

    Attributes:
        name: key in `Episode.states`.
        shape: shape of one frame's value.
        unit: e.g. ``"m"``; ``""`` for none.
        description: one phrase, including the frame of reference if there is one.
        kind: what the numbers are; or the kind of each entry of the last axis, for a pose, e.g.
            ``("position",) * 3 + ("quaternion",) * 4``.
        instances: name of the instance that each row belongs to, or one for all; empty if they
            belong to nothing that masks show.
        present: the field of kind ``presence`` that is 1 for rows that exist; empty if all do.
        symmetry: rotations after which the bodies look the same, of an angle or a quaternion.
        axis: the direction in the world around which an angle turns its body, if it does; empty
            for other angles, as those between two links.
        height: height z of the plane that positions of two numbers are on.
        follows: fields of which it is a function in every frame of an episode, as a hand's place is
            of the angles of joints.

    Raises:
        ShapeError: the shape or an option does not fit the kind.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    description: str
    kind: Kind | tuple[Kind, ...] = "value"
    instances: tuple[str, ...] = ()
    present: str = ""
    symmetry: BodySymmetry = "none"
    axis: tuple[()] | Vec3 = ()
    height: float = 0.0
    follows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", plain_unit(self.unit))
        for problem in self._problems():
            raise ShapeError(f"the state field {self.name!r} {problem}")

    @property
    def parts(self) -> tuple[Part, ...]:
        """Its numbers by kind, in the order in which these first come."""
        if isinstance(self.kind, str):
            return (Part(self.kind),)
        places: dict[Kind, list[int]] = {}
        for column, kind in enumerate(self.kind):
            places.setdefault(kind, []).append(column)
        return tuple(Part(kind, tuple(columns)) for kind, columns in places.items())

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of its parts."""
        return tuple(part.kind for part in self.parts)

    @property
    def entries(self) -> int:
        """How many numbers a row has: 1 of an angle or a presence, else the last axis."""
        return self.shape[-1] if self.shape and self.kind not in ("angle", "presence") else 1

    @property
    def rows(self) -> int:
        """How many rows it has: bodies, points or nodes."""
        return math.prod(self.shape) // self.entries

    @property
    def grid(self) -> tuple[int, ...]:
        """The grid that the nodes of a curve or surface form; empty for other kinds."""
        return self.shape[:-1] if self.kind in _GRIDS else ()

    @property
    def owners(self) -> tuple[str, ...]:
        """The instance of each row; empty if none is declared."""
        return self.instances * self.rows if len(self.instances) == 1 else self.instances

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict without what is as by default."""
        values = {
            option.name: (getattr(self, option.name), option.default) for option in fields(self)
        }
        return {
            k: value for k, (value, usual) in values.items() if usual is MISSING or value != usual
        }

    def _problems(self) -> Iterable[str]:
        """What is wrong with it, each a phrase that continues its name."""
        known, shape = get_args(Kind), list(self.shape)
        for kind in self.kinds:
            if kind not in known:
                yield f"has the kind {kind!r}: choose one of {', '.join(known)}"
        if not isinstance(self.kind, str):
            yield from self._problems_of_pose()
        elif self.kind in _GRIDS and not (
            len(shape) == _GRIDS[self.kind] + 1 and shape[-1] in _SIZES["position"]
        ):
            axes = {"curve": "(n, 2 or 3)", "surface": "(rows, columns, 2 or 3)"}[self.kind]
            yield f"is a {self.kind} of shape {shape}: give {axes}"
        for part in self.parts:
            size = len(part.columns) or self.entries
            if part.kind in _SIZES and (not shape or size not in _SIZES[part.kind]):
                sizes = " or ".join(map(str, _SIZES[part.kind]))
                yield f"has a {part.kind} of {size} numbers: give {sizes}, on the last axis"
        yield from self._problems_of_options()

    def _problems_of_pose(self) -> Iterable[str]:
        if len(self.kind) != (self.shape[-1] if self.shape else 0):
            yield f"has {len(self.kind)} kinds and the shape {list(self.shape)}: give one per entry"
        for kind in self.kind:
            if kind in _GRIDS or kind == "presence":
                yield f"has entries of the kind {kind!r}, which only a field of its own can be"

    def _problems_of_options(self) -> Iterable[str]:
        allowed = {symmetry for kind in self.kinds for symmetry in SYMMETRIES.get(kind, ("none",))}
        if self.symmetry not in allowed:
            yield (
                f"has the symmetry {self.symmetry!r}, which no {' or '.join(self.kinds)} has: "
                f"choose one of {', '.join(sorted(allowed))}"
            )
        if len(self.instances) > 1 and len(self.instances) != self.rows:
            yield f"has {self.rows} rows and {len(self.instances)} instances: give one per row"
        if self.kind in _GRIDS and len(self.instances) > 1:
            yield f"is a {self.kind} of {len(self.instances)} instances: it belongs to one"
        if self.axis and "angle" not in self.kinds:
            yield "has an axis, which only an angle has"
        if self.axis and not (
            len(self.axis) == 3 and math.isfinite(length := math.hypot(*self.axis)) and length > 0
        ):
            yield f"has the axis {list(self.axis)}: give a direction x, y, z"
        if not math.isfinite(self.height):
            yield f"has the height {self.height}: give a finite one"
        if self.name in (self.present, *self.follows):
            yield "names itself in present or follows"


def check_scene(state: Sequence[StateField], instances: Sequence[str]) -> None:
    """Check that fields name only fields and instances that there are.

    Raises:
        ShapeError: one names another.
    """
    by_name = {field.name: field for field in state}
    for field in state:
        who = f"the state field {field.name!r}"
        for name in (field.present, *field.follows):
            if name and name not in by_name:
                raise ShapeError(f"{who} refers to {name!r}, which is not a field of the state")
        for name in field.instances:
            if name not in instances:
                raise ShapeError(
                    f"{who} belongs to {name!r}, which is not an instance: choose "
                    f"one of {', '.join(instances)}"
                )
        if field.present:
            present = by_name[field.present]
            if present.kind != "presence" or present.rows != field.rows:
                raise ShapeError(
                    f"{who} has {field.rows} rows, which exist where {field.present!r} is 1: "
                    f"declare that one as a presence of shape [{field.rows}]"
                )
        _check_sources(field, by_name)


def without_dangling(
    state: Iterable[StateField], instances: Sequence[str]
) -> tuple[StateField, ...]:
    """Some fields of a card without what they say of others and of instances that are not kept."""
    kept = list(state)
    names = {field.name for field in kept}
    return tuple(
        replace(
            field,
            instances=field.instances if set(field.instances) <= set(instances) else (),
            present=field.present if field.present in names else "",
            follows=field.follows if set(field.follows) <= names else (),
        )
        for field in kept
    )


def _check_sources(field: StateField, by_name: Mapping[str, StateField]) -> None:
    """Refuse a field that follows from itself."""
    sources, passed = list(field.follows), set[str]()
    while sources:
        name = sources.pop()
        if name == field.name:
            raise ShapeError(f"the state field {name!r} follows from itself")
        if name in by_name and name not in passed:
            passed.add(name)
            sources += by_name[name].follows
