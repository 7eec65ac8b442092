"""Draws robot_arm: its cameras, colours and lights."""

from dataclasses import replace

import numpy as np

from acwm_kinematics.arm_simulation import TABLE, TABLE_CENTER, ArmSimulation, Post
from acwm_kinematics.states import ARM_CAMERA, ARM_LIGHT, GOALS, MAX_POSTS
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import Mesh, box, cylinder, join, plane
from acwm_sim.panda import add_panda

TABLE_ID, ARM_ID, GRIPPER_ID, FIRST_POST_ID = 1, 2, 3, 4
"""Instance ids; 0 is the floor. The ids of goals follow those of the posts."""

CAMERAS: dict[str, Camera] = {
    "front": ARM_CAMERA,
    "side": Camera(eye=(0.78, -1.75, 1.0), target=(0.25, 0.0, 0.34), fov=39),
    "high": Camera(eye=(1.3, -0.68, 1.85), target=(0.27, -0.02, 0.26), fov=39),
}

_ROOM = (0.20, 0.21, 0.235)  # background colour

LIGHTS: dict[str, Light] = {
    "noon": Light(
        direction=ARM_LIGHT,
        sun=(0.86, 0.84, 0.80),
        sky=(0.36, 0.38, 0.43),
        softness=0.008,
        background=_ROOM,
    ),
    "evening": Light(
        direction=(0.5, 1.0, 0.8),
        sun=(1.0, 0.74, 0.48),
        sky=(0.26, 0.28, 0.38),
        softness=0.008,
        background=_ROOM,
    ),
    "overcast": Light(
        sun=(0.30, 0.30, 0.30), sky=(0.66, 0.69, 0.74), softness=0.03, background=_ROOM
    ),
}

PALETTES: dict[str, tuple[Vec3, ...]] = {
    "bright": ((0.95, 0.56, 0.12), (0.16, 0.48, 0.88), (0.58, 0.34, 0.78), (0.10, 0.66, 0.66)),
    "pastel": ((0.96, 0.80, 0.60), (0.62, 0.77, 0.92), (0.80, 0.70, 0.90), (0.62, 0.86, 0.84)),
}
"""Colours of the posts, by the factor `colors`."""

WAITING, MET = (0.93, 0.14, 0.18), (0.24, 0.82, 0.34)
"""Colours of a goal before and after the hand has reached it."""


GOAL_RADIUS = 0.025
"""Radius of a drawn goal in metres."""

_TOP, _BODY = (0.23, 0.24, 0.265), (0.15, 0.155, 0.17)
_FLOOR, _LINE = (0.15, 0.155, 0.175), (0.36, 0.38, 0.42)
_FLOOR_Z = -0.75
_CELL, _WIDTH = 0.6, 0.009  # floor grid: side of a cell and half width of a line, metres


class ArmDrawing(Drawing[ArmSimulation]):
    """Draws the arm at its table."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0.25, 0.0, 0.1), 1.0)
    ao_radius = 0.06

    def _build(self) -> None:
        self._build_room()
        self.first_post: int = add_panda(self.scene, ARM_ID, GRIPPER_ID)
        for k in range(MAX_POSTS):
            shape = _shape(Post((0, 0), 0.03, 0.2, round=k % 2 == 0))
            self.scene.add_mesh(shape, instance=FIRST_POST_ID + k, gloss=0.15)
        self._goals = self.first_post + MAX_POSTS
        for k in range(GOALS):
            self.scene.add_spheres(1, instance=FIRST_POST_ID + MAX_POSTS + k, gloss=0.25)
        count = self._goals + GOALS
        self._places, self._turns = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))

    def _dress(self, simulation: ArmSimulation, factors: Factors) -> None:
        for k, color in enumerate(PALETTES[str(factors["colors"])]):
            self.scene.set_visible(self.first_post + k, k < len(simulation.posts))
            self.scene.set_color(self.first_post + k, color)
        for k, post in enumerate(simulation.posts):
            self.scene.reshape(self.first_post + k, _shape(post))
            self._places[self.first_post + k] = (*post.place, post.height / 2)
        for k, goal in enumerate(simulation.goals):
            self.scene.set_spheres(self._goals + k, goal[None], GOAL_RADIUS)

    def draw(self, simulation: ArmSimulation) -> Frame:
        for k, reached in enumerate(simulation.reached):
            self.scene.set_color(self._goals + k, MET if reached else WAITING)
        arm = slice(self.first_post)
        self._places[arm], self._turns[arm] = simulation.panda.poses
        return self.scene.render(self._places, self._turns)

    def _build_room(self) -> None:
        """A table on a floor with a grid."""
        add = self.scene.add_mesh
        add(plane(12.0, 24).moved((0, 0, _FLOOR_Z)), _FLOOR, static=True, gloss=0.0)
        add(_grid().moved((0, 0, _FLOOR_Z + 0.001)), static=True, gloss=0.0)
        add(box(TABLE, 0.006).moved(TABLE_CENTER), _TOP, static=True, instance=TABLE_ID, gloss=0.2)
        legs = (TABLE[0] - 0.05, TABLE[1] - 0.05, -(_FLOOR_Z + 2 * TABLE[2]) / 2)
        body = box(legs, 0.004).moved((TABLE_CENTER[0], 0, (_FLOOR_Z - 2 * TABLE[2]) / 2))
        add(body, _BODY, static=True, instance=TABLE_ID, gloss=0.1)


def _shape(post: Post) -> Mesh:
    half = post.height / 2
    if post.round:
        return cylinder(post.radius, half, 0.004)
    return box((post.radius, post.radius, half), 0.004)


def _grid() -> Mesh:
    """Lines on the floor, in short pieces, that fade with distance."""
    half, steps = _CELL / 2, (np.arange(-10, 10) + 0.5) * _CELL
    pieces = [
        plane((a + _WIDTH, b + _WIDTH)).moved((x + b, y + a, 0))
        for x in steps
        for y in steps
        for a, b in ((half, 0), (0, half))
    ]
    lines = join(*pieces)
    near = np.clip(1.6 - np.linalg.norm(lines.vertices, axis=1) / 2.6, 0, 1)[:, None]
    colors = (near * np.array(_LINE) + (1 - near) * np.array(_FLOOR)).astype(np.float32)
    return replace(lines, colors=colors)
