"""Draws push_sand: its cameras, colours and lights."""

import numpy as np

from acwm_particle.sand import Sand
from acwm_particle.sand_layout import DOUBLED
from acwm_particle.states import SAND_CAMERA, SUN
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, box, capsule, cylinder, join, plane

SAND_ID, BOARD_ID = 1, 2
"""Instance ids; 0 is the ground."""

CAMERAS: dict[str, Camera] = {
    "front": SAND_CAMERA,
    "left": Camera(eye=(-0.62, -0.84, 0.86), target=(0.0, -0.03, 0.0), fov=38),
    "top": Camera(eye=(0.0, -0.30, 1.28), target=(0.0, -0.01, 0.0), fov=38),
}

SANDS: dict[str, Vec3] = {
    "dune": (0.87, 0.70, 0.42),
    "slate": (0.47, 0.50, 0.55),
    "terracotta": (0.76, 0.40, 0.27),
}

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=SUN, softness=0.003),
    "evening": Light(direction=(-1.0, -0.35, 0.75), sun=(0.92, 0.70, 0.48), sky=(0.26, 0.28, 0.38)),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.03),
}

_SHADES = np.linspace(0.78, 1.10, 7)[:, None]
"""Shades of grains: grain i has shade i modulo the number of shades."""

_TILES = ((0.90, 0.895, 0.88), (0.855, 0.85, 0.83))
_BOARD, _HANDLE, _KNOB = (0.16, 0.43, 0.80), (0.22, 0.23, 0.26), (0.93, 0.35, 0.14)


class SandDrawing(Drawing[Sand]):
    """Draws sand and board."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0.0, 0.0, 0.05), 0.85)
    ao_radius = 0.018

    def _build(self) -> None:
        self.scene.add_mesh(plane(4.0, 50, _TILES), static=True, gloss=0.0)
        self.scene.add_spheres(DOUBLED, instance=SAND_ID, gloss=0.03)
        self._board = self.scene.add_mesh(_board((0.01, 0.15, 0.065)), instance=BOARD_ID, gloss=0.2)

    def _dress(self, simulation: Sand, factors: Factors) -> None:
        self.scene.reshape(self._board, _board(tuple(simulation.half.tolist())))
        shades = np.resize(_SHADES, (DOUBLED, 1))
        sand = SANDS[str(factors["colors"])]
        self._paint = np.minimum(shades * sand, 1.0).astype(np.float32)
        self._colors = self._paint.copy()

    def draw(self, simulation: Sand) -> Frame:
        sand = simulation
        # Draw from near to far, so that few grains are drawn that are hidden later.
        away = sand.grains - np.asarray(self.scene.camera.eye, np.float32)
        order = np.argsort((away**2).sum(1), kind="stable")
        centers, radii = np.tile(sand.grains[0], (DOUBLED, 1)), np.zeros(DOUBLED)
        centers[: len(order)], radii[: len(order)] = sand.grains[order], sand.radius
        self.scene.set_spheres(0, centers, radii)
        self._colors[: len(order)] = self._paint[order]
        self.scene.set_sphere_colors(0, self._colors)
        places, turns = np.zeros((2, 3)), np.zeros((2, 3, 3))
        places[1], turns[1] = sand.board.position, sand.board.rotation
        return self.scene.render(places, turns)


def _board(half: tuple[float, float, float]) -> Mesh:
    """A board with a rod and a knob on top as a handle."""
    rod = cylinder(0.008, 0.05).moved((0, 0, half[2] + 0.045))
    knob = capsule(0.016, 0.012).moved((0, 0, half[2] + 0.10))
    return join(box(half, 0.003).painted(_BOARD), rod.painted(_HANDLE), knob.painted(_KNOB))
