"""What push_cube looks like: camera, colours, lights."""

import numpy as np
from numpy.typing import NDArray

from acwm_rigid.physics import INNER, PUSHER_RADIUS, TABLE_CAMERA
from acwm_rigid.table import FIRST_BODY_ID, WALL, WALL_HEIGHT, WALL_ID
from acwm_sim.camera import Light, Vec3
from acwm_sim.meshes import box, cylinder, join, plane
from acwm_sim.scene import Scene

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
"""Colours of the cubes, by slot."""

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=(0.35, -0.45, 1.2), sun=(0.68, 0.66, 0.62), sky=(0.40, 0.42, 0.47)),
    "evening": Light(direction=(-1.0, -0.55, 0.9), sun=(0.86, 0.66, 0.46), sky=(0.28, 0.30, 0.40)),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.02),
}

_PUSHERS: tuple[Vec3, ...] = ((0.10, 0.11, 0.13), (0.06, 0.48, 0.50))
_HALF_HEIGHT = 0.05
_EDGE = 0.08


class Look:
    """Draws a table; the still parts are prepared once and kept from episode to episode.

    Args:
        size: frame size (H, W).
        pushers: how many.
    """

    def __init__(self, size: tuple[int, int], pushers: int) -> None:
        self.scene = Scene(TABLE_CAMERA, LIGHTS["noon"], size, ((0, 0, 0), 0.5), ao_radius=0.035)
        self._build_table()
        self._pushers, self._cubes = pushers, len(PALETTES["bright"])
        for k in range(pushers):
            shape = cylinder(PUSHER_RADIUS, _HALF_HEIGHT, 0.004)
            self.scene.add_mesh(shape, _PUSHERS[k], instance=FIRST_BODY_ID + k, gloss=0.15)
        for slot in range(self._cubes):
            self.scene.add_mesh(box(_EDGE / 2, 0.004), instance=FIRST_BODY_ID + pushers + slot)

    def _build_table(self) -> None:
        self.scene.add_mesh(plane(0.8), (0.93, 0.92, 0.90), static=True, gloss=0.0)
        side, out, half = INNER + 2 * WALL, INNER + WALL, WALL_HEIGHT / 2
        bars = [
            box((a, b, half), 0.003).moved((x, y, half))
            for x, y, a, b in (
                (out, 0, WALL, side),
                (-out, 0, WALL, side),
                (0, out, side, WALL),
                (0, -out, side, WALL),
            )
        ]
        self.scene.add_mesh(join(*bars), (0.62, 0.50, 0.38), static=True, instance=WALL_ID)

    def dress(self, slots: tuple[int, ...], palette: str, light: str) -> None:
        """Choose which cubes are there, their colours and the light."""
        self.scene.set_light(LIGHTS[light])
        for slot in range(self._cubes):
            self.scene.set_visible(self._pushers + slot, slot in slots)
            self.scene.set_color(self._pushers + slot, PALETTES[palette][slot])

    def draw(
        self,
        poses: tuple[NDArray[np.float64], NDArray[np.float64]],
        slots: tuple[int, ...],
        edge: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The frame and mask of pushers and cubes at `poses`; `edge` is a cube's, in metres."""
        count = self._pushers + self._cubes
        places, turns = np.zeros((count, 3)), np.zeros((count, 3, 3))
        rows = [*range(self._pushers), *(self._pushers + slot for slot in slots)]
        places[rows], turns[rows] = poses
        places[: self._pushers, 2] = _HALF_HEIGHT
        turns[self._pushers :] *= edge / _EDGE
        return self.scene.render(places, turns)
