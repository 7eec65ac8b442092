"""Draws push_rope: rope, pole, table; its cameras, colours and lights."""

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.rope import Cord, Rope
from acwm_deformable.states import NODES, POLE_HALF, ROPE_CAMERA
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, cylinder, plane

ROPE_ID, POLE_ID = 1, 2
"""Instance ids; 0 is the table."""

MAX_LENGTH = 3.6
"""Largest length of rope in metres that can be drawn."""

CAMERAS: dict[str, Camera] = {
    "front": ROPE_CAMERA,
    "top": Camera(eye=(0.0, 0.0, 4.6), up=(0.0, 1.0, 0.0), fov=32.0),
    "corner": Camera(eye=(1.7, -2.2, 4.0), target=(0.0, -0.08, 0.0), fov=33.0),
}

LIGHTS: dict[str, Light] = {
    "noon": Light((-0.75, -0.25, 1.2), (0.68, 0.66, 0.62), (0.40, 0.42, 0.47), softness=0.012),
    "evening": Light((1.0, 0.35, 0.85), (0.86, 0.66, 0.46), (0.28, 0.30, 0.40), softness=0.012),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.05),
}

COLORS: dict[str, tuple[Vec3, Vec3, Vec3]] = {
    "red": ((0.84, 0.20, 0.16), (0.97, 0.89, 0.74), (0.13, 0.42, 0.82)),
    "green": ((0.16, 0.55, 0.32), (0.96, 0.82, 0.32), (0.86, 0.36, 0.12)),
    "pastel": ((0.93, 0.60, 0.57), (0.96, 0.93, 0.90), (0.60, 0.75, 0.90)),
}
"""Colours of the two stripes of the rope and of the pole, by the factor `colors`."""

_TILES = ((0.85, 0.84, 0.82), (0.80, 0.79, 0.77))
_STRIPE = 0.1  # metres
_STRIPES = round(MAX_LENGTH / _STRIPE)
_RINGS, _AROUND = 4, 7  # vertices along a stripe and around it
_CAP = 3  # additional rings that round off an end of the rope


class RopeDrawing(Drawing[Rope]):
    """Draws rope and pole."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0, 0, 0), 1.9)
    ao_radius = 0.07

    def _build(self) -> None:
        """Add the table, the pole, and the stripes of a rope, which `draw` places later."""
        self.scene.add_mesh(plane(4.0, 20, _TILES), static=True, gloss=0.0)
        pole = cylinder(POLE_RADIUS, POLE_HALF, 0.008)
        self.scene.add_mesh(pole, instance=POLE_ID, gloss=0.15)
        for _ in range(_STRIPES):
            self.scene.add_mesh(_stripe(), instance=ROPE_ID, gloss=0.06)

    def _dress(self, simulation: Rope, factors: Factors) -> None:
        self._tube = Tube(simulation.cord)
        first, second, pole = COLORS[str(factors["colors"])]
        self.scene.set_color(0, pole)
        for k in range(_STRIPES):
            self.scene.set_color(1 + k, (first, second)[k % 2])
            self.scene.set_visible(1 + k, k < self._tube.stripes)

    def draw(self, simulation: Rope) -> Frame:
        places, turns = np.zeros((1 + _STRIPES, 3)), np.tile(np.eye(3), (1 + _STRIPES, 1, 1))
        places[0] = (*simulation.pole, POLE_HALF)
        surface = zip(*self._tube.around(simulation.nodes), strict=True)
        for k, (vertices, normals) in enumerate(surface):
            self.scene.set_vertices(1 + k, vertices, normals)
        return self.scene.render(places, turns)


class Tube:
    """The surface of a rope, in stripes of equal length; the last one may be shorter.

    The lower side is never visible and left out.
    """

    def __init__(self, cord: Cord) -> None:
        self.stripes = int(np.ceil(cord.length / _STRIPE - 1e-6))
        ends = np.minimum(np.arange(self.stripes + 1) * _STRIPE, cord.length)
        share = np.linspace(0.0, 1.0, _RINGS)
        rings = ends[:-1, None] * (1 - share) + ends[1:, None] * share
        # Caps are shrunken rings of the first and last stripe; other stripes repeat a ring.
        bow = np.linspace(np.pi / 2, 0.0, _CAP + 1)[:-1]
        self._shift, self._width = np.zeros((2, self.stripes, _RINGS + 2 * _CAP))
        self._width[:] = 1
        self._shift[0, :_CAP], self._width[0, :_CAP] = -np.sin(bow), np.cos(bow)
        self._shift[-1, -_CAP:], self._width[-1, -_CAP:] = np.sin(bow)[::-1], np.cos(bow)[::-1]
        at = np.hstack([np.repeat(rings[:, :1], _CAP, 1), rings, np.repeat(rings[:, -1:], _CAP, 1)])
        self._radius, self._at = cord.radius, at / cord.spacing
        angle = np.linspace(-0.35, np.pi + 0.35, _AROUND)
        self._side, self._up = np.cos(angle), np.sin(angle)

    def around(
        self, nodes: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vertices and normals [stripes, V, 3] around a smooth curve through `nodes`."""
        center, ahead = _curve(np.asarray(nodes, np.float64), self._at)
        left = np.stack([-ahead[..., 1], ahead[..., 0]], -1)
        center = center + ahead * (self._shift * self._radius)[..., None]
        shape = (*self._at.shape, _AROUND)
        normals, width = np.empty((*shape, 3)), self._width[..., None]
        normals[..., :2] = width[..., None] * self._side[:, None] * left[..., None, :]
        normals[..., :2] += (self._shift[..., None] * ahead)[..., None, :]
        normals[..., 2] = width * self._up
        vertices = np.empty_like(normals)
        vertices[..., :2] = center[..., None, :]
        vertices[..., :2] += (self._radius * width * self._side)[..., None] * left[..., None, :]
        vertices[..., 2] = self._radius * (1 + width * self._up)
        count = self.stripes
        return vertices.reshape(count, -1, 3), normals.reshape(count, -1, 3)


def _curve(
    nodes: NDArray[np.float64], at: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and unit tangents [..., 2] of a Catmull-Rom spline at positions `at`, in segments."""
    ends = 2 * nodes[[0, -1]] - nodes[[1, -2]]
    padded = np.vstack([ends[:1], nodes, ends[1:]])
    first = np.clip(at.astype(int), 0, NODES - 2)
    t = (at - first)[..., None]
    a, b, c, d = (padded[first + k] for k in range(4))
    tangent, bow, twist = (c - a) / 2, a - 2.5 * b + 2 * c - d / 2, (d - a) / 2 + 1.5 * (b - c)
    points = b + t * (tangent + t * (bow + t * twist))
    slope = tangent + t * (2 * bow + 3 * t * twist)
    return points, slope / np.linalg.norm(slope, axis=-1, keepdims=True)


def _stripe() -> Mesh:
    """Triangles of one stripe, without a shape yet, oriented so that the outside is visible."""
    rings = _RINGS + 2 * _CAP
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(_AROUND - 1), indexing="ij")
    a = (i * _AROUND + j).ravel()
    b, c, d = a + _AROUND, a + _AROUND + 1, a + 1
    triangles = np.vstack([np.column_stack([a, c, b]), np.column_stack([a, d, c])])
    empty = np.zeros((rings * _AROUND, 3), np.float32)
    return Mesh(empty, empty, triangles.astype(np.int32))
