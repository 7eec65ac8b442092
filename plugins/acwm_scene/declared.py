"""Which groups a scene has: what the environment's card declares, as the groups' arguments."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from acwm_core.env.camera import Camera
from acwm_core.env.card import EnvironmentCard, StateField
from acwm_core.env.rotations import FOLDS

Kind = Literal["values", "bodies", "nodes"]

LINES = ("curve", "surface")
"""Kinds of fields whose rows are the nodes of one body."""

MOST_VALUES = 256
"""Most numbers of a field that is taken for values without having been asked for."""

UNITS = {"bodies": 4.2, "nodes": 10.0}
"""Units from the middle of the picture to its upper edge where none are given: a body is about a
unit large, and nodes are a fraction of one apart."""


def unit_of(camera: Camera, kind: Kind) -> float:
    """Metres that count as one in a group of this kind, by what the camera sees."""
    return camera.half_extent / UNITS[kind]


@dataclass(frozen=True)
class GroupSpec:
    """A group of a scene.

    Attributes:
        kind: of the group.
        columns: which of the values of the states are its own, in the order of the kind: of values
            those that follow from others last; of bodies the agents' places, presence, places and
            angles; of nodes the agents' places and those of the nodes.
        following: how many values follow from the others.
        angles: which of the values, by their place among `columns`, are angles in rad.
        agents: number of agents, which the actions move.
        bodies: number of bodies, which agents push.
        folds: in how many ways a body can be turned and look the same.
        has_presence: whether it is recorded which bodies there are.
        axes: coordinates of each place, 2 or 3.
        nodes: number of nodes along each side of a rope or cloth.
        camera: of the card.
        light: direction to the light whose shadows on the ground z = 0 are seen, if any.
    """

    kind: Kind
    columns: tuple[int, ...]
    following: int = 0
    angles: tuple[int, ...] = ()
    agents: int = 0
    bodies: int = 0
    folds: int = 1
    has_presence: bool = False
    axes: int = 2
    nodes: tuple[int, ...] = ()
    camera: Camera | None = None
    light: tuple[float, float, float] | None = None


def groups_of(card: EnvironmentCard | None, states: Sequence[str]) -> dict[str, Any]:
    """The arguments `specs` and `state_size` of a scene that learns these fields of the state.

    Nodes are the fields that are a curve or a surface. Bodies are the fields of positions and
    angles of the same instances, and what says which of these exist. With either, and without
    values, positions of other instances are the agents. All else is values. Without states there
    are no groups.
    """
    if card is None or not states:
        return {"specs": {}, "state_size": 0}
    starts, size = dict[str, int](), 0
    for name in states:
        starts[name] = size
        size += math.prod(card.fields[name].shape)
    chosen, columns = [card.fields[name] for name in states], _Columns(starts)
    spec = _nodes(chosen, columns, card) or _bodies(chosen, columns, card)
    specs = {spec.kind: spec} if spec else {}
    rest = [field for field in chosen if not spec or field.name not in columns.taken]
    if rest:
        specs["values"] = _values(rest, columns)
    return {"specs": specs, "state_size": size}


def default_states(card: EnvironmentCard, changing: Collection[str]) -> tuple[str, ...]:
    """The fields of the state that a scene learns if nobody chooses: what moves, and moves it.

    Nodes or bodies and their agents, if the card declares any; else all that changes.

    Args:
        card: of the environment.
        changing: names of the fields that change within episodes.
    """
    things = [field for field in card.state if field.name in changing]
    things += [field for field in card.state if field.name in {thing.present for thing in things}]
    places = [field for field in things if field.kind in ("position", "angle", "presence", *LINES)]
    columns = _Columns(dict.fromkeys((field.name for field in places), 0))
    if _nodes(places, columns, card) or _bodies(places, columns, card):
        return tuple(field.name for field in card.state if field.name in columns.taken)
    sizes = {field.name: math.prod(field.shape) for field in things}
    return tuple(field.name for field in card.state if 0 < sizes.get(field.name, 0) <= MOST_VALUES)


class _Columns:
    """Numbers of the values of fields among all states, and which fields were asked for."""

    def __init__(self, starts: dict[str, int]) -> None:
        self._starts, self.taken = starts, set[str]()

    def of(self, *fields: StateField) -> tuple[int, ...]:
        self.taken |= {field.name for field in fields}
        return tuple(
            self._starts[field.name] + number
            for field in fields
            for number in range(math.prod(field.shape))
        )


def _values(fields: Sequence[StateField], columns: _Columns) -> GroupSpec:
    names = {field.name for field in fields}
    following = [field for field in fields if field.follows and {*field.follows} <= names]
    moved = [field for field in fields if field not in following]
    ordered, angles, place = [*moved, *following], list[int](), 0
    for field in ordered:
        size = math.prod(field.shape)
        if field.kind == "angle":
            angles += range(place, place + size)
        place += size
    count = sum(math.prod(field.shape) for field in following)
    return GroupSpec("values", columns.of(*ordered), count, tuple(angles))


def _nodes(
    fields: Sequence[StateField], columns: _Columns, card: EnvironmentCard
) -> GroupSpec | None:
    lines = [field for field in fields if field.kind in LINES]
    if len(lines) != 1 or card.camera is None:
        return None
    axes = lines[0].shape[-1]
    agents = [field for field in fields if field.kind == "position" and field.entries == axes]
    if not agents:
        return None
    return GroupSpec(
        "nodes",
        columns.of(*agents, lines[0]),
        agents=sum(field.rows for field in agents),
        axes=axes,
        nodes=lines[0].grid,
        camera=card.camera,
        light=card.light if axes == 3 else None,
    )


def _bodies(
    fields: Sequence[StateField], columns: _Columns, card: EnvironmentCard
) -> GroupSpec | None:
    angles = {field.owners: field for field in fields if field.kind == "angle" and field.owners}
    positions = [field for field in fields if field.kind == "position"]
    bodies = [field for field in positions if field.owners in angles]
    names = {name for field in bodies for name in field.owners}
    agents = [field for field in positions if field.entries == 2 and not names & {*field.owners}]
    if len(bodies) != 1 or not agents or card.camera is None:
        return None
    body = bodies[0]
    angle = angles[body.owners]
    present = [field for field in fields if field.name == body.present]
    return GroupSpec(
        "bodies",
        columns.of(*agents, *present, body, angle),
        agents=sum(field.rows for field in agents),
        bodies=body.rows,
        folds=FOLDS[angle.symmetry],
        has_presence=bool(present),
        axes=body.entries,
        camera=card.camera,
    )
