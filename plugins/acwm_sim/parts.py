"""Geometry of many parts in a few flat arrays, so that one launch draws them all."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acwm_sim.camera import Vec3, linear
from acwm_sim.meshes import Mesh


@dataclass
class Parts:
    """A growing collection of parts: meshes under a pose each, and groups of spheres.

    The arrays are those of the kernels: `local` [V, 6] points and normals in the part's frame,
    `color` [V, 4] linear colour and gloss, `owner` [V], `triangles` [F, 4] three vertices and the
    part, `balls` [P, 8] centre, radius, linear colour, gloss, `ball_owner` [P], `table` [N, 3]
    instance id, solid, visible.
    """

    local: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 6), np.float32))
    color: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    owner: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    triangles: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 4), np.int32))
    balls: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 8), np.float32))
    ball_owner: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    table: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 9), np.float32))

    def __len__(self) -> int:
        return len(self.table)

    def add_mesh(self, mesh: Mesh, color: Vec3, gloss: float, instance: int, solid: bool) -> int:
        """Append a mesh; returns its part number."""
        part = self._add(instance, solid)
        start, count = len(self.local), len(mesh.vertices)
        paint = np.tile(linear(color), (count, 1)) if mesh.colors is None else linear(mesh.colors)
        shiny = np.full((count, 1), gloss, np.float32)
        self.local = _stack(self.local, np.hstack([mesh.vertices, mesh.normals]))
        self.color = _stack(self.color, np.hstack([paint, shiny]))
        self.owner = _stack(self.owner, np.full(count, part, np.int32))
        owners = np.full((len(mesh.triangles), 1), part, np.int32)
        self.triangles = _stack(self.triangles, np.hstack([mesh.triangles + start, owners]))
        return part

    def add_spheres(self, count: int, color: Vec3, gloss: float, instance: int) -> int:
        """Append a group of spheres, of radius zero until they are placed; returns its number."""
        part = self._add(instance, solid=True)
        balls = np.zeros((count, 8), np.float32)
        balls[:, 4:7], balls[:, 7] = linear(color), gloss
        self.balls = _stack(self.balls, balls)
        self.ball_owner = _stack(self.ball_owner, np.full(count, part, np.int32))
        return part

    def _add(self, instance: int, solid: bool) -> int:
        if not 0 <= instance < 256:
            raise ValueError(f"instance id {instance} does not fit in the mask's byte")
        self.table = _stack(self.table, np.array([[instance, solid, 1]], np.int32))
        return len(self.table) - 1


def _stack(old: NDArray, new: NDArray) -> NDArray:
    return np.ascontiguousarray(np.concatenate([old, new.astype(old.dtype)]))
