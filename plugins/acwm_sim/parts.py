"""The geometry of many parts in a few flat arrays, so that one kernel launch draws them all."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_sim.camera import Vec3, linear
from acwm_sim.meshes import Mesh

INSTANCE, SOLID, VISIBLE, KIND, VERT_0, VERT_1, TRI_0, TRI_1, BALL_0, BALL_1 = range(10)
"""Columns of a part's row in the table: id in the mask, whether it is seen from outside only,
whether it is visible, kind, and its first and past-the-last vertex, triangle and sphere."""

OPAQUE, GLASS, FLUID = range(3)
"""Kinds of parts. The colour of glass is the light it lets through; a fluid's spheres are its
particles."""

MAX_PARTS = 1000
"""Most static parts, and most moving parts; a sample's label has eleven bits for the part."""


@dataclass
class Fluid:
    """The one fluid that a scene may hold.

    Attributes:
        part: its part number.
        color: linear colour of white light after `depth` metres of fluid.
        depth: metres.
        haze: share of light, 0 to 1, that `depth` metres of fluid scatter towards the eye.
        radius: half the spacing of its particles at rest in metres.
    """

    part: int
    color: NDArray[np.float32]
    depth: float
    haze: float
    radius: float = 0.01


class Parts:
    """A growing collection of parts: meshes with one pose each, and groups of spheres.

    Attributes:
        table: int32 [N, 10], a row for each part.
        vertices: float32 [V, 10]; point and normal in the part's frame, linear colour, gloss.
        triangles: int32 [F, 3].
        balls: float32 [P, 8]; centre in the world, radius, linear colour, gloss.
        fluid: the look of the fluid among the parts, or None.
    """

    def __init__(self) -> None:
        self.table = np.zeros((0, 10), np.int32)
        self.vertices = np.zeros((0, 10), np.float32)
        self.triangles = np.zeros((0, 3), np.int32)
        self.balls = np.zeros((0, 8), np.float32)
        self.fluid: Fluid | None = None

    def __len__(self) -> int:
        return len(self.table)

    @property
    def clear(self) -> bool:
        """Whether any of the parts is glass or fluid."""
        return bool((self.table[:, KIND] != OPAQUE).any())

    def add_mesh(
        self, mesh: Mesh, color: Vec3, gloss: float, instance: int, solid: bool, kind: int = OPAQUE
    ) -> int:
        """Append a mesh; returns its part number."""
        count = len(mesh.vertices)
        paint = np.tile(linear(color), (count, 1)) if mesh.colors is None else linear(mesh.colors)
        shiny = np.full((count, 1), gloss)
        rows = np.hstack([mesh.vertices, mesh.normals, paint, shiny])
        return self._add((instance, solid, 1, kind), rows, mesh.triangles + len(self.vertices))

    def add_spheres(
        self, count: int, color: Vec3, gloss: float, instance: int, kind: int = OPAQUE
    ) -> int:
        """Append a group of spheres, radius 0 until they are placed; returns its part number."""
        balls = np.zeros((count, 8))
        balls[:, 4:7], balls[:, 7] = linear(color), gloss
        empty = np.zeros((0, 10)), np.zeros((0, 3))
        return self._add((instance, True, 1, kind), *empty, balls)

    def verts_of(self, part: int) -> NDArray[np.float32]:
        """The rows of `vertices` that belong to a part, to write to."""
        return self.vertices[self.table[part, VERT_0] : self.table[part, VERT_1]]

    def balls_of(self, part: int) -> NDArray[np.float32]:
        """The rows of `balls` that belong to a part, to write to."""
        return self.balls[self.table[part, BALL_0] : self.table[part, BALL_1]]

    def resize_balls(self, part: int, count: int) -> NDArray[np.float32]:
        """Change the number of spheres in a group; returns their rows, to write to."""
        start, end = self.table[part, [BALL_0, BALL_1]]
        if count != end - start:
            rows = np.zeros((count, 8), np.float32)
            self.balls = np.concatenate([self.balls[:start], rows, self.balls[end:]])
            self.table[part, BALL_1] = start + count
            self.table[part + 1 :, [BALL_0, BALL_1]] += count - (end - start)
        return self.balls_of(part)

    def _add(
        self,
        head: tuple[int, bool, int, int],
        vertices: NDArray,
        triangles: NDArray,
        balls: NDArray | None = None,
    ) -> int:
        if not 0 <= head[0] < 256:
            raise ValueError(f"instance id {head[0]} does not fit in the mask's byte")
        if len(self.table) >= MAX_PARTS:
            raise ValueError(f"a scene can hold {MAX_PARTS} parts: join meshes that move together")
        starts = [len(self.vertices), len(self.triangles), len(self.balls)]
        self.vertices = _stack(self.vertices, vertices)
        self.triangles = _stack(self.triangles, triangles)
        self.balls = _stack(self.balls, np.zeros((0, 8)) if balls is None else balls)
        ends = [len(self.vertices), len(self.triangles), len(self.balls)]
        ranges = np.column_stack([starts, ends]).ravel()
        self.table = _stack(self.table, np.array([[*head, *ranges]]))
        return len(self.table) - 1


def _stack(old: NDArray, new: NDArray) -> NDArray:
    return np.ascontiguousarray(np.concatenate([old, new.astype(old.dtype)]))
