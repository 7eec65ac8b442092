"""Draws push_cube: its camera, colours and lights."""

import numpy as np

from acwm_rigid.physics import INNER, PUSHER_RADIUS
from acwm_rigid.push_simulation import (
    FIRST_BODY_ID,
    WALL,
    WALL_HEIGHT,
    WALL_ID,
    PushSimulation,
)
from acwm_rigid.states import MAX_CUBES, PUSHER_HEIGHT, TABLE_CAMERA
from acwm_sim.camera import Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import box, cylinder, frame_of_boxes, plane

CAMERAS = {"front": TABLE_CAMERA}

PALETTES: dict[str, tuple[Vec3, ...]] = {
    "bright": (
        (0.86, 0.22, 0.18),
        (0.16, 0.48, 0.85),
        (0.22, 0.66, 0.32),
        (0.96, 0.74, 0.16),
        (0.60, 0.32, 0.74),
    ),
    "pastel": (
        (0.93, 0.62, 0.58),
        (0.58, 0.75, 0.90),
        (0.62, 0.83, 0.64),
        (0.95, 0.86, 0.58),
        (0.78, 0.66, 0.86),
    ),
}
"""Colours of the cubes by slot, for each value of the factor `colors`."""

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=(0.35, -0.45, 1.2), sun=(0.68, 0.66, 0.62), sky=(0.40, 0.42, 0.47)),
    "evening": Light(direction=(-1.0, -0.55, 0.9), sun=(0.86, 0.66, 0.46), sky=(0.28, 0.30, 0.40)),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.02),
}

_PUSHERS: tuple[Vec3, ...] = ((0.10, 0.11, 0.13), (0.06, 0.48, 0.50))
_EDGE = 0.08


class PushDrawing(Drawing[PushSimulation]):
    """Draws a table, a pusher and the cubes of the episode."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0, 0, 0), 0.5)
    ao_radius = 0.035
    pushers = 1

    def _build(self) -> None:
        self._build_table()
        for k in range(self.pushers):
            shape = cylinder(PUSHER_RADIUS, PUSHER_HEIGHT, 0.004)
            self.scene.add_mesh(shape, _PUSHERS[k], instance=FIRST_BODY_ID + k, gloss=0.15)
        for body in range(self.pushers, self.pushers + MAX_CUBES):
            self.scene.add_mesh(box(_EDGE / 2, 0.004), instance=FIRST_BODY_ID + body)

    def _build_table(self) -> None:
        self.scene.add_mesh(plane(0.8), (0.93, 0.92, 0.90), static=True, gloss=0.0)
        walls = frame_of_boxes(INNER, WALL, WALL_HEIGHT, 0.003)
        self.scene.add_mesh(walls, (0.62, 0.50, 0.38), static=True, instance=WALL_ID)

    def _dress(self, simulation: PushSimulation, factors: Factors) -> None:
        for slot, color in enumerate(PALETTES[str(factors["colors"])]):
            self.scene.set_visible(self.pushers + slot, slot in simulation.cubes.slots)
            self.scene.set_color(self.pushers + slot, color)

    def draw(self, simulation: PushSimulation) -> Frame:
        cubes, count = simulation.cubes, self.pushers + MAX_CUBES
        places, turns = np.zeros((count, 3)), np.zeros((count, 3, 3))
        rows = [*range(self.pushers), *(self.pushers + slot for slot in cubes.slots)]
        places[rows], turns[rows] = simulation.poses
        places[: self.pushers, 2] = PUSHER_HEIGHT
        turns[self.pushers :] *= cubes.edge / _EDGE
        return self.scene.render(places, turns)


class TwoPusherDrawing(PushDrawing):
    """Draws push_cube with two pushers."""

    pushers = 2
