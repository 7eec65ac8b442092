"""What is read of an environment, and how: the layout of a network's outputs.

Each network that ships has its layout here, by the name of its weights. What the scene is like,
its camera and what can be measured in it, is the environment's to say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal

from acwm_core.errors import PluginError
from acwm_core.estimator import ViewingCamera
from acwm_estimators.limits import ideal_physics_of
from acwm_estimators.plugin import WEIGHTS


@dataclass(frozen=True)
class Points:
    """Positions, each with a heat map of its own, from which it is read locally.

    Attributes:
        field: state field, `[rows, D]` or `[D]`; of more than three columns the first three.
        instances: to which each row belongs; a row is not seen where these have no pixels.
        plane: height z in metres of the plane on which two-dimensional positions lie; None reads
            three dimensions, the depth from a map.
    """

    field: str
    instances: tuple[str, ...]
    plane: float | None = None

    @property
    def rows(self) -> int:
        """How many heat maps it has."""
        return len(self.instances)


@dataclass(frozen=True)
class Curve:
    """A long thin body, traced through its mask from either end to the other.

    Attributes:
        field: state field of its nodes, `[N, 2]`.
        length: state field of its length, `[1]`.
        instance: the body.
        cover: an instance that may stand before it.
        plane: height z in metres on which it lies.
        end: how far its round ends reach beyond its nodes, m.
    """

    field: str
    length: str
    instance: str
    cover: str
    plane: float
    end: float


Encoding = Literal["value", "angle", "yaw", "axes"]
"""How numbers are regressed:

* ``value``: as they are.
* ``angle``: in radians, by sine and cosine of `fold` times the angle.
* ``yaw``: a quaternion of a body that stays level, by its heading as an angle.
* ``axes``: a quaternion of a box, by the outer products of its x and z axes with themselves, which
  half turns do not change.
"""

WIDTH: dict[Encoding, int] = {"value": 1, "angle": 2, "yaw": 2, "axes": 12}
"""Channels that one number (a quaternion for the last two) takes."""


@dataclass(frozen=True)
class Local:
    """Numbers read where a point is: one for each row of `under`.

    Attributes:
        field: state field with as many rows, or fewer: then the first rows of `under`.
        under: field of the `Points` whose heat maps say where.
        count: how many rows are read.
        encoding: how.
        fold: by how many parts of a full turn an angle or yaw can change unseen.
        column: last column of the field to take, for a number that is a part of a field.
        whole: all pixels of the row's instance say it, not those where the point is.
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
    """Heights over a grid on the ground, read where each cell is seen.

    Attributes:
        field: state field `[rows, columns]`, rows from near to far, columns from left to right.
        cells: rows and columns.
        extent: half the grid's depth and width in metres, around the origin.
        height: at which cells are looked up, m.
    """

    field: str
    cells: tuple[int, int]
    extent: tuple[float, float]
    height: float


@dataclass(frozen=True)
class Layout:
    """What is read of one environment.

    Attributes:
        camera: of the nominal factors.
        instances: names of the instances that are told apart.
        points: positions.
        locals: numbers read where points are.
        totals: names of amounts that are sums over the frame, see `acwm_estimators.targets`.
        surface: heights, if there are any.
        curves: traced through masks.
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
        KeyError: no weights ship for it.
        PluginError: its package does not say from where it is seen.
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
"""By the name of the weights."""
