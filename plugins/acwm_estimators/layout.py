"""What is read from an environment, and how: the layout of a network's outputs.

Each network that ships has its layout here, under the name of its weights. Where things are, whose
they are and which turns look the same is on the environment's card.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

from acwm_core.env.camera import Camera
from acwm_core.env.physics import Physics
from acwm_core.env.rotations import FOLDS
from acwm_core.env.state_field import SYMMETRIES
from acwm_core.errors import PluginError
from acwm_estimators.camera import FittedCamera
from acwm_estimators.limits import ideal_physics_of
from acwm_estimators.plugin import WEIGHTS


@dataclass(frozen=True)
class Points:
    """Positions, each read locally from its own heat map.

    Attributes:
        field: state field, `[rows, D]` or `[D]`; only the first three columns are read.
        instances: the instance that each row belongs to; a row is not seen if its instance has no
            pixels.
        plane: height z in metres of the plane of two-dimensional positions. None reads three
            dimensions, with the depth from a map.
        present: state field that is 1 for rows that exist; empty if all do.
    """

    field: str
    instances: tuple[str, ...]
    plane: float | None = None
    present: str = ""

    @property
    def rows(self) -> int:
        """Number of heat maps."""
        return len(self.instances)


@dataclass(frozen=True)
class CurveField:
    """A long thin body, traced through its mask from one end to the other.

    Attributes:
        field: state field of its nodes, `[N, 2]`.
        length: state field of its length, `[1]`.
        instance: name of the body's instance.
        cover: name of an instance that may be in front of it.
        plane: height z in metres at which it lies.
        end: distance in metres by which its round ends extend beyond its nodes.
    """

    field: str
    length: str
    instance: str
    cover: str
    plane: float
    end: float


Encoding = Literal["value", "angle", "yaw", "axes"]
"""How numbers are regressed:

* ``value``: directly.
* ``angle``: an angle in radians, as sine and cosine of `fold` times the angle.
* ``yaw``: a quaternion of a body that stays level, as the angle of its heading.
* ``axes``: a quaternion of a box, as the outer products of its x and z axes with themselves, which
  half turns do not change.
"""

WIDTH: dict[Encoding, int] = {"value": 1, "angle": 2, "yaw": 2, "axes": 12}
"""Channels per number (per quaternion for the last two)."""


@dataclass(frozen=True)
class Local:
    """Numbers that are read at points: one for each row of `under`.

    Attributes:
        field: state field with one row per point, or with fewer rows, for the first points.
        under: field of the `Points` whose heat maps give the places.
        count: number of rows that are read.
        encoding: how the numbers are encoded.
        fold: rotational symmetry of an angle or yaw: turns by 1/fold of a full turn look the same.
        column: column of the field, for a number that is only a part of a field.
        whole: read it from all pixels of the row's instance, not from those at the point.
    """

    field: str
    under: str
    count: int
    encoding: Encoding = "value"
    fold: int = 1
    column: int | None = None
    whole: bool = False

    @property
    def width(self) -> int:
        """Channels of its map."""
        return WIDTH[self.encoding]


@dataclass(frozen=True)
class Surface:
    """Heights over a grid on the ground, read at the pixels that show each cell.

    Attributes:
        field: state field `[rows, columns]`, rows from near to far, columns from left to right.
        cells: number of rows and columns.
        extent: half of the grid's depth and width in metres; its centre is the origin.
        height: height in metres at which cells are looked up.
    """

    field: str
    cells: tuple[int, int]
    extent: tuple[float, float]
    height: float


@dataclass(frozen=True)
class Layout:
    """What is read from one environment.

    Attributes:
        camera: camera for the nominal factors.
        instances: names of the instances that are segmented.
        points: positions.
        locals: numbers that are read at points.
        totals: names of amounts, which are sums over the frame; see `acwm_estimators.targets`.
        surface: heights, if there are any.
        curves: bodies that are traced through masks.
    """

    camera: Camera | FittedCamera
    instances: tuple[str, ...]
    points: tuple[Points, ...]
    locals: tuple[Local, ...] = ()
    totals: tuple[str, ...] = ()
    surface: Surface | None = None
    curves: tuple[CurveField, ...] = ()


@cache
def layout_of(environment: str) -> Layout:
    """The layout of the network that reads an environment, with the environment's camera.

    Raises:
        KeyError: no weights ship for the environment.
        PluginError: the environment's physics has no camera.
    """
    return LAYOUTS[WEIGHTS[environment]](ideal_physics_of(environment))


def _camera(physics: Physics) -> Camera:
    if physics.camera is None:
        raise PluginError("the physics of this environment names no camera")
    return physics.camera


def _points(physics: Physics, name: str, *instances: str) -> Points:
    """The positions in a field, with its own instances or those in whose pixels they are read."""
    field = physics.fields[name]
    plane = field.height if field.shape[-1] == 2 else None
    return Points(name, instances or field.owners, plane, field.present)


def _turns(physics: Physics, name: str, under: str) -> Local:
    """The angles or quaternions in a field, one for each row of `under`."""
    field = physics.fields[name]
    (part,) = (part for part in field.parts if part.kind in SYMMETRIES)
    encoding: Encoding = "axes" if field.symmetry == "box" else "yaw"
    return Local(
        name,
        under,
        field.rows,
        "angle" if part.kind == "angle" else encoding,
        FOLDS[field.symmetry],
        part.columns[0] if part.columns else None,
        whole=True,
    )


def _push_cube(physics: Physics) -> Layout:
    pushers, cubes = (_points(physics, f"{who}_position") for who in ("pusher", "cube"))
    return Layout(
        _camera(physics),
        ("wall", *pushers.instances, *cubes.instances),
        (pushers, cubes),
        (_turns(physics, "cube_yaw", "cube_position"),),
    )


def _stack_cube(physics: Physics) -> Layout:
    return Layout(
        _camera(physics),
        ("arm", "gripper", "red_cube", "green_cube"),
        (_points(physics, "hand_position"), _points(physics, "cube_position")),
        (
            Local("gripper_opening", "hand_position", 1),
            _turns(physics, "cube_quaternion", "cube_position"),
        ),
    )


def _push_rope(physics: Physics) -> Layout:
    rope = physics.fields["rope_position"]
    curve = CurveField(rope.name, "rope_length", "rope", "pole", plane=rope.height, end=0.035)
    return Layout(
        _camera(physics), ("rope", "pole"), (_points(physics, "pole_position"),), curves=(curve,)
    )


def _cloth_move(physics: Physics) -> Layout:
    hands, sphere = (_points(physics, f"{who}_position") for who in ("gripper", "sphere"))
    return Layout(_camera(physics), ("sphere", "cloth", *hands.instances), (hands, sphere))


def _push_sand(physics: Physics) -> Layout:
    return Layout(
        _camera(physics),
        ("sand", "board"),
        (_points(physics, "board_position"),),
        (_turns(physics, "board_quaternion", "board_position"),),
        totals=("grain_count",),
        surface=Surface("sand_height", (24, 40), (0.48, 0.80), 0.03),
    )


def _pour_water(physics: Physics) -> Layout:
    return Layout(
        _camera(physics),
        ("cup", "container", "water", "holder"),
        (_points(physics, "cup_pose"), _points(physics, "container_position")),
        (_turns(physics, "cup_pose", "cup_pose"),),
        totals=("water_cup", "water_container", "water_spilled", "water_air"),
    )


def _robot_arm(physics: Physics) -> Layout:
    links, hand, posts = (
        _points(physics, f"{what}_position") for what in ("link", "hand", "obstacle")
    )
    return Layout(
        _camera(physics), ("table", "arm", "gripper", *posts.instances), (links, hand, posts)
    )


def _reacher(physics: Physics) -> Layout:
    return Layout(
        _camera(physics),
        ("wall", "base", "upper_arm", "forearm", "fingertip", "goal"),
        (
            _points(physics, "elbow_position", "forearm"),
            _points(physics, "fingertip_position"),
            _points(physics, "goal_position"),
        ),
    )


LAYOUTS: dict[str, Callable[[Physics], Layout]] = {
    "push_cube": _push_cube,
    "push_cube_two_pushers": _push_cube,
    "stack_cube": _stack_cube,
    "push_rope": _push_rope,
    "cloth_move": _cloth_move,
    "push_sand": _push_sand,
    "pour_water": _pour_water,
    "robot_arm": _robot_arm,
    "reacher": _reacher,
}
"""Layouts by the name of the weights."""
