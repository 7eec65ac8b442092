"""What is read from an environment, and how: the layout of a network's outputs.

Each network that ships has its layout here, under the name of its weights. The environment itself
defines the scene: its camera and what can be measured in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal

from acwm_core.env.physics import ViewingCamera
from acwm_core.errors import PluginError
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
    """

    field: str
    instances: tuple[str, ...]
    plane: float | None = None

    @property
    def rows(self) -> int:
        """Number of heat maps."""
        return len(self.instances)


@dataclass(frozen=True)
class Curve:
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

    camera: ViewingCamera
    instances: tuple[str, ...]
    points: tuple[Points, ...]
    locals: tuple[Local, ...] = ()
    totals: tuple[str, ...] = ()
    surface: Surface | None = None
    curves: tuple[Curve, ...] = ()


@cache
def layout_of(environment: str) -> Layout:
    """The layout of the network that reads an environment, with the environment's camera.

    Raises:
        KeyError: no weights ship for the environment.
        PluginError: the environment's physics has no camera.
    """
    camera = ideal_physics_of(environment).camera
    if camera is None:
        raise PluginError(f"the physics of environment {environment!r} names no camera")
    return LAYOUTS[WEIGHTS[environment]](camera)


_CUBES = ("cube_1", "cube_2", "cube_3", "cube_4", "cube_5")
_POSTS = ("obstacle_1", "obstacle_2", "obstacle_3", "obstacle_4")
_GRIPPERS = ("gripper_1", "gripper_2")


def _push_cube(camera: ViewingCamera, pushers: tuple[str, ...] = ("pusher",)) -> Layout:
    return Layout(
        camera,
        ("wall", *pushers, *_CUBES),
        (Points("pusher_position", pushers, plane=0.05), Points("cube_position", _CUBES)),
        (Local("cube_yaw", "cube_position", len(_CUBES), "angle", fold=4, whole=True),),
    )


LAYOUTS: dict[str, Callable[[ViewingCamera], Layout]] = {
    "push_cube": _push_cube,
    "push_cube_two_pushers": partial(_push_cube, pushers=("pusher_1", "pusher_2")),
    "stack_cube": partial(
        Layout,
        instances=("arm", "gripper", "red_cube", "green_cube"),
        points=(
            Points("hand_position", ("gripper",)),
            Points("cube_position", ("red_cube", "green_cube")),
        ),
        locals=(
            Local("gripper_opening", "hand_position", 1),
            Local("cube_quaternion", "cube_position", 2, "yaw", fold=4, whole=True),
        ),
    ),
    "push_rope": partial(
        Layout,
        instances=("rope", "pole"),
        points=(Points("pole_position", ("pole",), plane=0.16),),
        curves=(Curve("rope_position", "rope_length", "rope", "pole", plane=0.035, end=0.035),),
    ),
    "cloth_move": partial(
        Layout,
        instances=("sphere", "cloth", *_GRIPPERS),
        points=(Points("gripper_position", _GRIPPERS), Points("sphere_position", ("sphere",))),
    ),
    "push_sand": partial(
        Layout,
        instances=("sand", "board"),
        points=(Points("board_position", ("board",)),),
        locals=(Local("board_quaternion", "board_position", 1, "axes", whole=True),),
        totals=("grain_count",),
        surface=Surface("sand_height", (24, 40), (0.48, 0.80), 0.03),
    ),
    "pour_water": partial(
        Layout,
        instances=("cup", "container", "water", "holder"),
        points=(Points("cup_pose", ("cup",)), Points("container_position", ("container",))),
        locals=(Local("cup_pose", "cup_pose", 1, "angle", column=3, whole=True),),
        totals=("water_cup", "water_container", "water_spilled", "water_air"),
    ),
    "robot_arm": partial(
        Layout,
        instances=("table", "arm", "gripper", *_POSTS),
        points=(
            Points("link_position", ("arm",) * 7 + ("gripper",)),
            Points("hand_position", ("gripper",)),
            Points("obstacle_position", _POSTS),
        ),
    ),
    "reacher": partial(
        Layout,
        instances=("wall", "base", "upper_arm", "forearm", "fingertip", "goal"),
        points=(
            Points("elbow_position", ("forearm",), plane=0.198),
            Points("fingertip_position", ("forearm",), plane=0.198),
            Points("goal_position", ("goal",), plane=0.0),
        ),
    ),
}
"""Layouts by the name of the weights."""
