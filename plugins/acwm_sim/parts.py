"""Geometry of many parts in a few flat arrays, so that one launch draws them all."""

import numpy as np
from numpy.typing import NDArray

from acwm_sim.camera import Vec3, linear
from acwm_sim.meshes import Mesh

INSTANCE, SOLID, VISIBLE, VERT_0, VERT_1, TRI_0, TRI_1, BALL_0, BALL_1 = range(9)
"""Columns of a part's row in the table: id in the mask, seen from outside only, shown, and its
first and past-the-last vertex, triangle and sphere."""

MOST_PARTS = 1000
"""Static and moving ones apart; a sample's label has eleven bits for the part."""


class Parts:
    """A growing collection of parts: meshes under a pose each, and groups of spheres.

    Attributes:
        table: int32 [N, 9], a row for each part.
        vertices: float32 [V, 10]; point and normal in the part's frame, linear colour, gloss.
        triangles: int32 [F, 3].
        balls: float32 [P, 8]; centre in the world, radius, linear colour, gloss.
    """

    def __init__(self) -> None:
        self.table = np.zeros((0, 9), np.int32)
        self.vertices = np.zeros((0, 10), np.float32)
        self.triangles = np.zeros((0, 3), np.int32)
        self.balls = np.zeros((0, 8), np.float32)

    def __len__(self) -> int:
        return len(self.table)

    def add_mesh(self, mesh: Mesh, color: Vec3, gloss: float, instance: int, solid: bool) -> int:
        """Append a mesh; returns its part number."""
        count = len(mesh.vertices)
        paint = np.tile(linear(color), (count, 1)) if mesh.colors is None else linear(mesh.colors)
        shiny = np.full((count, 1), gloss)
        rows = np.hstack([mesh.vertices, mesh.normals, paint, shiny])
        return self._add(instance, solid, rows, mesh.triangles + len(self.vertices))

    def add_spheres(self, count: int, color: Vec3, gloss: float, instance: int) -> int:
        """Append a group of spheres, of radius zero until they are placed; returns its number."""
        balls = np.zeros((count, 8))
        balls[:, 4:7], balls[:, 7] = linear(color), gloss
        return self._add(instance, True, np.zeros((0, 10)), np.zeros((0, 3)), balls)

    def verts_of(self, part: int) -> NDArray[np.float32]:
        """The rows of `vertices` that belong to a part, to write to."""
        return self.vertices[self.table[part, VERT_0] : self.table[part, VERT_1]]

    def balls_of(self, part: int) -> NDArray[np.float32]:
        """The rows of `balls` that belong to a part, to write to."""
        return self.balls[self.table[part, BALL_0] : self.table[part, BALL_1]]

    def _add(
        self,
        instance: int,
        solid: bool,
        vertices: NDArray,
        triangles: NDArray,
        balls: NDArray | None = None,
    ) -> int:
        if not 0 <= instance < 256:
            raise ValueError(f"instance id {instance} does not fit in the mask's byte")
        if len(self.table) >= MOST_PARTS:
            raise ValueError(f"a scene can hold {MOST_PARTS} parts: join meshes that move together")
        starts = [len(self.vertices), len(self.triangles), len(self.balls)]
        self.vertices = _stack(self.vertices, vertices)
        self.triangles = _stack(self.triangles, triangles)
        self.balls = _stack(self.balls, np.zeros((0, 8)) if balls is None else balls)
        ends = [len(self.vertices), len(self.triangles), len(self.balls)]
        ranges = np.column_stack([starts, ends]).ravel()
        self.table = _stack(self.table, np.array([[instance, solid, 1, *ranges]]))
        return len(self.table) - 1


def _stack(old: NDArray, new: NDArray) -> NDArray:
    return np.ascontiguousarray(np.concatenate([old, new.astype(old.dtype)]))
