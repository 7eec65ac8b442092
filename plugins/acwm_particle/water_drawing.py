"""Draws pour_water: its cameras, colours and lights."""

import numpy as np

from acwm_particle.cup import THICKNESS, Vessel, tilted
from acwm_particle.physics import CONTAINER, CUP
from acwm_particle.states import SUN, WATER_CAMERA
from acwm_particle.water import RADIUS, Water
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, box, join, lathe, plane

CUP_ID, CONTAINER_ID, WATER_ID, HOLDER_ID = 1, 2, 3, 4
"""Instance ids; 0 is the table."""

CAMERAS: dict[str, Camera] = {
    "front": WATER_CAMERA,
    "left": Camera(eye=(-2.4, -4.7, 2.35), target=(-0.18, 0.0, 0.95), fov=37),
    "high": Camera(eye=(-0.2, -4.2, 3.9), target=(-0.2, 0.0, 0.85), fov=38),
}

WATERS: dict[str, Vec3] = {
    "sea": (0.16, 0.47, 0.85),
    "amber": (0.93, 0.58, 0.12),
    "berry": (0.74, 0.16, 0.36),
    "mint": (0.20, 0.70, 0.52),
}

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=SUN, softness=0.012),
    "evening": Light(direction=(-1.0, -0.35, 0.75), sun=(0.92, 0.70, 0.48), sky=(0.26, 0.28, 0.38)),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.08),
}

_TILES = ((0.90, 0.895, 0.88), (0.855, 0.85, 0.83))
_STEEL, _GRIP = (0.22, 0.23, 0.26), (0.93, 0.45, 0.14)

_DEPTH = 0.9
"""Depth of water in metres at which white light takes on its display colour."""


class WaterDrawing(Drawing[Water]):
    """Draws the water, the cup with its holder, and the container."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((-0.2, 0.0, 0.9), 2.2)
    ao_radius = 0.12

    def _build(self) -> None:
        self.scene.add_mesh(plane(21.0, 70, _TILES), static=True, gloss=0.0)
        self._water = self.scene.add_fluid(instance=WATER_ID, depth=_DEPTH)
        self.scene.add_glass(_glass(CUP), instance=CUP_ID)
        self._container = self.scene.add_glass(_glass(CONTAINER), instance=CONTAINER_ID)
        self.scene.add_mesh(_holder(CUP), instance=HOLDER_ID, gloss=0.3)

    def _dress(self, simulation: Water, factors: Factors) -> None:
        self.scene.reshape(self._container, _glass(simulation.cup.container))
        self.scene.set_color(self._water, WATERS[str(factors["colors"])])

    def draw(self, simulation: Water) -> Frame:
        self.scene.set_fluid(self._water, simulation.particles, RADIUS)
        cup = simulation.cup
        places, turns = np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
        places[1] = places[3] = cup.pose[:3]
        turns[1] = turns[3] = tilted(float(cup.pose[3]))
        places[2] = [*cup.place, THICKNESS + cup.container.tall / 2]
        return self.scene.render(places, turns)


def _ring(inner: float, outer: float, low: float, high: float) -> Mesh:
    """A ring with a rectangular cross section around z."""
    bands = [
        ([(outer, low), (outer, high)], [(1, 0), (1, 0)]),
        ([(inner, low), (inner, high)], [(-1, 0), (-1, 0)]),
        ([(inner, high), (outer, high)], [(0, 1), (0, 1)]),
        ([(inner, low), (outer, low)], [(0, -1), (0, -1)]),
    ]
    profile, normals = zip(*bands, strict=True)
    return lathe(profile, normals, 32)


def _glass(vessel: Vessel) -> Mesh:
    """A vessel with both faces of its wall and floor, and bevelled edges."""
    half, inner, outer, edge = vessel.tall / 2, vessel.inner, vessel.outer, THICKNESS / 2
    foot, middle = -half - THICKNESS, (inner + outer) / 2
    bands = [
        ([(outer, foot + edge), (outer, half - edge)], [(1, 0), (1, 0)]),
        ([(inner, -half), (inner, half - edge)], [(-1, 0), (-1, 0)]),
        ([(0, foot), (outer - edge, foot)], [(0, -1), (0, -1)]),
        ([(0, -half), (inner, -half)], [(0, 1), (0, 1)]),
        ([(outer - edge, foot), (outer, foot + edge)], [(0, -1), (1, 0)]),
        ([(inner, half - edge), (middle, half)], [(-1, 0), (0, 1)]),
        ([(middle, half), (outer, half - edge)], [(0, 1), (1, 0)]),
    ]
    profile, normals = zip(*bands, strict=True)
    return lathe(profile, normals, 32)


def _holder(cup: Vessel) -> Mesh:
    """A clamp around the cup, and the arm that holds it."""
    out = cup.outer
    return join(
        _ring(out, out + 0.03, 0.16, 0.26).painted(_STEEL),
        box((0.12, 0.10, 0.11), 0.015).moved((-out - 0.13, 0, 0.21)).painted(_GRIP),
        box((1.2, 0.05, 0.05), 0.01).moved((-out - 1.40, 0, 0.21)).painted(_STEEL),
    )
