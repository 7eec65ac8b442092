"""Draws reacher: arm, marker, walls; its cameras, colours and lights."""

import numpy as np

from acwm_kinematics.physics import MARKER_RADIUS
from acwm_kinematics.reacher_arm import LINK_RADIUS, Arm
from acwm_kinematics.states import FOREARM_HEIGHT, REACHER_CAMERA
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, box, cylinder, frame_of_boxes, join, plane

WALL_ID, BASE_ID, UPPER_ID, FORE_ID, TIP_ID, GOAL_ID = range(1, 7)
"""Instance ids; 0 is the floor."""

INNER = 1.08
"""Half width of the floor between the walls in metres: beyond the reach of the longest arm."""

CAMERAS: dict[str, Camera] = {
    "front": REACHER_CAMERA,
    "top": Camera(eye=(0.0, 0.0, 3.65), up=(0.0, 1.0, 0.0), fov=37.0),
    "corner": Camera(eye=(1.3, -1.7, 3.4), target=(0.0, -0.08, 0.0), fov=46.5),
}

LIGHTS: dict[str, Light] = {
    "noon": Light((0.45, 0.35, 1.2), (0.68, 0.66, 0.62), (0.40, 0.42, 0.47), softness=0.012),
    "evening": Light((-1.0, 0.5, 0.9), (0.86, 0.66, 0.46), (0.28, 0.30, 0.40), softness=0.012),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.05),
}

COLORS: dict[str, tuple[Vec3, Vec3, Vec3]] = {
    "blue": ((0.13, 0.42, 0.82), (0.97, 0.72, 0.14), (0.88, 0.20, 0.17)),
    "violet": ((0.55, 0.28, 0.70), (0.30, 0.70, 0.42), (0.95, 0.50, 0.10)),
    "pastel": ((0.58, 0.75, 0.90), (0.95, 0.84, 0.56), (0.93, 0.60, 0.57)),
}
"""Colours of upper arm, forearm and marker, by the factor `colors`."""

_DARK, _WHITE, _WOOD = (0.17, 0.18, 0.20), (0.97, 0.96, 0.94), (0.62, 0.50, 0.38)
_TILES = ((0.93, 0.92, 0.90), (0.885, 0.875, 0.855))
_WALL, _WALL_HEIGHT = 0.04, 0.10  # half thickness and height, metres
_THICK = 0.03  # half thickness of a link; between the two is a gap of 8 mm
_PIN = 0.03  # radius of the pins in the joints and of the fingertip
_FORE_Z = FOREARM_HEIGHT
_UPPER_Z = 0.13  # height of the middle of the upper arm
_UPPER, _FORE, _CAP, _TIP, _RINGS, _WHITE_RING = range(6)  # moving parts


class ReacherDrawing(Drawing[Arm]):
    """Draws the arm, the marker of its goal, and the walls."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0.0, 0.0, 0.0), 1.75)
    ao_radius = 0.09

    def _build(self) -> None:
        """Add all parts; links get their lengths and colours later."""
        scene = self.scene
        scene.add_mesh(plane(4.0), _TILES[0], static=True, gloss=0.0)
        floor = plane(INNER, 8, _TILES).moved((0, 0, 0.001))
        scene.add_mesh(floor, static=True, gloss=0.0)
        walls = frame_of_boxes(INNER, _WALL, _WALL_HEIGHT, 0.008)
        scene.add_mesh(walls, _WOOD, static=True, instance=WALL_ID)
        low = (_UPPER_Z - _THICK) / 2
        foot = cylinder(0.115, _UPPER_Z / 2 - _THICK / 2, 0.012).moved((0, 0, low))
        pin = cylinder(_PIN, 0.003).moved((0, 0, _UPPER_Z + _THICK + 0.003))
        scene.add_mesh(join(foot, pin), _DARK, static=True, instance=BASE_ID, gloss=0.15)
        scene.add_mesh(_link(0.5), instance=UPPER_ID, gloss=0.15)
        scene.add_mesh(_link(0.4), instance=FORE_ID, gloss=0.15)
        cap = cylinder(_PIN, 0.006, 0.002).moved((0, 0, _THICK + 0.006))
        scene.add_mesh(cap, _DARK, instance=FORE_ID, gloss=0.15)
        top = _FORE_Z + _THICK + 0.012
        rod = cylinder(_PIN, top / 2 - 0.006, 0.004).moved((0, 0, top / 2 + 0.006))
        scene.add_mesh(rod, _DARK, instance=TIP_ID, gloss=0.15)
        rings = join(_disc(MARKER_RADIUS, 0.004), _disc(MARKER_RADIUS * 0.44, 0.008))
        scene.add_mesh(rings, instance=GOAL_ID, gloss=0.0)
        scene.add_mesh(_disc(MARKER_RADIUS * 0.64, 0.006), _WHITE, instance=GOAL_ID, gloss=0.0)

    def _dress(self, simulation: Arm, factors: Factors) -> None:
        for link, length in zip((_UPPER, _FORE), simulation.links.lengths, strict=True):
            self.scene.reshape(link, _link(length))
        colors = COLORS[str(factors["colors"])]
        for number, paint in zip((_UPPER, _FORE, _RINGS), colors, strict=True):
            self.scene.set_color(number, paint)

    def draw(self, simulation: Arm) -> Frame:
        places, turns = np.zeros((6, 3)), np.tile(np.eye(3), (6, 1, 1))
        elbow, tip = simulation.points(simulation.angles)
        places[_UPPER, 2] = _UPPER_Z
        places[[_FORE, _CAP], :2], places[[_FORE, _CAP], 2] = elbow, _FORE_Z
        places[_TIP, :2] = tip
        places[[_RINGS, _WHITE_RING], :2] = simulation.goal
        for link, heading in zip((_UPPER, _FORE), np.cumsum(simulation.angles), strict=True):
            cos, sin = np.cos(heading), np.sin(heading)
            turns[link, :2, :2] = [[cos, -sin], [sin, cos]]
        return self.scene.render(places, turns)


def _link(length: float) -> Mesh:
    """A flat bar with round ends, along x from one joint to the next."""
    end = cylinder(LINK_RADIUS, _THICK, 0.008)
    bar = box((length / 2, LINK_RADIUS, _THICK), 0.008).moved((length / 2, 0, 0))
    return join(end, end.moved((length, 0, 0)), bar)


def _disc(radius: float, top: float) -> Mesh:
    """A flat disc on the floor whose upper side is at height `top`."""
    return cylinder(radius, top / 2).moved((0, 0, top / 2))
