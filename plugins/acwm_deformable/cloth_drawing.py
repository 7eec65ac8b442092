"""Draws cloth_move: its cameras, colours and lights."""

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.cloth import Cloth
from acwm_deformable.cloth_start import CELLS, NODES
from acwm_deformable.states import CLOTH_CAMERA, CLOTH_LIGHT
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, capsule, cylinder, join, plane

SPHERE_ID, CLOTH_ID, HAND_ID = 1, 2, 3
"""Instance ids; the id of the second gripper follows."""

CAMERAS: dict[str, Camera] = {
    "front": CLOTH_CAMERA,
    "side": Camera(eye=(1.4, -1.63, 1.55), target=(0.0, 0.0, 0.33), fov=39),
    "high": Camera(eye=(0.0, -1.2, 2.4), target=(0.0, 0.05, 0.33), fov=39),
}

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=CLOTH_LIGHT, softness=0.012),
    "evening": Light(
        direction=(-1.0, -0.55, 0.9),
        sun=(0.92, 0.70, 0.48),
        sky=(0.26, 0.28, 0.38),
        softness=0.012,
    ),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.035),
}

_BLUE, _WHITE = (0.13, 0.40, 0.80), (0.95, 0.95, 0.93)
_RED, _CREAM = (0.78, 0.16, 0.20), (0.96, 0.92, 0.82)
PATTERNS: dict[str, tuple[Vec3, Vec3, str]] = {
    "checks": (_BLUE, _WHITE, "checks"),
    "stripes": (_BLUE, _WHITE, "stripes"),
    "red checks": (_RED, _CREAM, "checks"),
    "plain": ((0.20, 0.55, 0.38), (0.20, 0.55, 0.38), "checks"),
}
"""Two colours of the cloth and their pattern, by the factor `pattern`."""

_SPHERE_COLOR = (0.94, 0.48, 0.16)
_HAND_COLORS: tuple[Vec3, Vec3] = ((0.80, 0.10, 0.24), (0.98, 0.78, 0.12))
_STEEL = (0.20, 0.21, 0.24)
_PATCHES, _PATCH = 8, CELLS // 8
_BACK = 0.72  # brightness of the back of the cloth, relative to the front
_JAW, _OPEN, _CLOSED = 0.026, 0.045, 0.006  # radius of a jaw, and its distance from the middle


class ClothDrawing(Drawing[Cloth]):
    """Draws sphere, cloth and grippers; a new sphere or pattern rebuilds the whole scene."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0, 0, 0.25), 1.35)
    ao_radius = 0.06

    def __init__(self, size: tuple[int, int]) -> None:
        self._corner_of = _patch_nodes()
        self.pattern, self.radius = "checks", 0.2
        super().__init__(size)

    def _build(self) -> None:
        scene = self.scene
        floor = plane(12.0, 96, [(0.93, 0.92, 0.90), (0.875, 0.865, 0.845)])
        scene.add_mesh(floor, static=True, gloss=0.0)
        ball = capsule(self.radius, 0.0, 96, 24).moved((0, 0, self.radius))
        scene.add_mesh(ball, _SPHERE_COLOR, static=True, instance=SPHERE_ID, gloss=0.25)
        front, back = _cloth_meshes(self.pattern, self._corner_of)
        self._front = scene.add_mesh(front, instance=CLOTH_ID, gloss=0.02)
        self._back = scene.add_mesh(back, instance=CLOTH_ID, gloss=0.02)
        self._rods = [scene.add_mesh(_rod(), _STEEL, instance=HAND_ID + k) for k in range(2)]
        self._jaws = [
            scene.add_spheres(2, _HAND_COLORS[k], instance=HAND_ID + k, gloss=0.3) for k in range(2)
        ]

    def _dress(self, simulation: Cloth, factors: Factors) -> None:
        self.rebuild(str(factors["pattern"]), simulation.sheet.sphere)

    def rebuild(self, pattern: str, radius: float) -> None:
        """Rebuild the scene for another cloth pattern or sphere radius (metres)."""
        if (pattern, radius) != (self.pattern, self.radius):
            self.pattern, self.radius = pattern, radius
            self._clear()
            self._build()

    def draw(self, simulation: Cloth) -> Frame:
        cloth = simulation
        normals = normals_of(cloth.nodes)[self._corner_of]
        nodes = cloth.nodes[self._corner_of]
        self.scene.set_vertices(self._front, nodes, normals)
        self.scene.set_vertices(self._back, nodes, -normals)
        places, turns = np.zeros((6, 3)), np.tile(np.eye(3), (6, 1, 1))
        for k, (hand, held) in enumerate(zip(cloth.hands, cloth.held, strict=True)):
            places[self._rods[k]] = hand
            side = np.array([_CLOSED if held >= 0 else _OPEN, 0.0, 0.0])
            self.scene.set_spheres(self._jaws[k], [hand - side, hand + side], _JAW)
        return self.scene.render(places, turns)


def normals_of(nodes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit normals [N, 3] of a square grid of nodes, smooth across cells."""
    grid = nodes.reshape(NODES, NODES, 3)
    down, across = np.empty_like(grid), np.empty_like(grid)
    down[1:-1], down[0], down[-1] = grid[2:] - grid[:-2], grid[1] - grid[0], grid[-1] - grid[-2]
    across[:, 1:-1] = grid[:, 2:] - grid[:, :-2]
    across[:, 0], across[:, -1] = grid[:, 1] - grid[:, 0], grid[:, -1] - grid[:, -2]
    a, b = down.reshape(-1, 3), across.reshape(-1, 3)
    normal = np.empty_like(a)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[:, k] = a[:, i] * b[:, j] - a[:, j] * b[:, i]
    length = np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    return normal / np.maximum(length, 1e-12)


def _patch_nodes() -> NDArray[np.int64]:
    """The node of every vertex, by patch; patches share no vertices, so colour edges stay sharp."""
    step = np.arange(_PATCH + 1)
    local = step[:, None] * NODES + step[None]
    first = np.arange(_PATCHES) * _PATCH
    return (first[:, None, None, None] * NODES + first[None, :, None, None] + local).ravel()


def _cloth_meshes(pattern: str, nodes: NDArray[np.int64]) -> tuple[Mesh, Mesh]:
    """Front and back of the cloth; each is visible from its own side only."""
    first, second, kind = PATTERNS[pattern]
    row, column = np.divmod(np.arange(_PATCHES**2), _PATCHES)
    odd = (row + column if kind == "checks" else column) % 2
    paint = np.where(odd[:, None] == 1, second, first)
    side = _PATCH + 1
    colors = np.repeat(paint, side**2, axis=0).astype(np.float32)
    cell = (np.arange(_PATCH)[:, None] * side + np.arange(_PATCH)[None]).ravel()
    corner = (np.arange(_PATCHES**2)[:, None] * side**2 + cell).ravel()
    a, b, c, d = corner, corner + side, corner + side + 1, corner + 1
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    flat = np.zeros((len(nodes), 3), np.float32)
    front = Mesh(flat, flat, triangles, colors)
    return front, Mesh(flat, flat, triangles[:, ::-1].copy(), colors * np.float32(_BACK))


def _rod() -> Mesh:
    """A gripper's arm: a thin vertical rod with a short cross bar at its lower end."""
    bar = cylinder(0.007, _OPEN, segments=12)
    lying = Mesh(bar.vertices[:, [2, 0, 1]], bar.normals[:, [2, 0, 1]], bar.triangles)
    rod = cylinder(0.009, 0.15, segments=16).moved((0, 0, _JAW + 0.15))
    return join(rod, lying.moved((0, 0, _JAW)))
