"""What is read of an environment, and how: the layout of a network's outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from acwm_estimators.pinhole import Pinhole


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

    camera: Pinhole
    instances: tuple[str, ...]
    points: tuple[Points, ...]
    locals: tuple[Local, ...] = ()
    totals: tuple[str, ...] = ()
    surface: Surface | None = None
    curves: tuple[Curve, ...] = ()
