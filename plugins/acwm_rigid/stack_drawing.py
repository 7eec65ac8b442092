"""Draws stack_cube: its cameras, colours and lights."""

from acwm_rigid.stack_simulation import ARM_ID, GREEN_ID, GRIPPER_ID, RED_ID, StackSimulation
from acwm_rigid.states import STACK_CAMERA, STACK_LIGHT
from acwm_sim.camera import Camera, Light, Vec3
from acwm_sim.environment import Drawing, Factors, Frame
from acwm_sim.meshes import box, plane
from acwm_sim.panda import add_panda

CAMERAS: dict[str, Camera] = {
    "front": STACK_CAMERA,
    "side": Camera(eye=(0.42, -1.25, 0.75), target=(0.40, 0.0, 0.18), fov=35),
    "high": Camera(eye=(1.12, -0.35, 1.15), target=(0.43, 0.0, 0.14), fov=33),
}

PALETTES: dict[str, tuple[Vec3, Vec3]] = {
    "bright": ((0.86, 0.18, 0.15), (0.16, 0.60, 0.27)),
    "dark": ((0.52, 0.08, 0.09), (0.05, 0.33, 0.17)),
    "pastel": ((0.95, 0.60, 0.56), (0.62, 0.84, 0.62)),
}
"""Colours of the red and the green cube, by the factor `colors`."""

LIGHTS: dict[str, Light] = {
    "noon": Light(direction=STACK_LIGHT, softness=0.008),
    "evening": Light(
        direction=(0.3, 1.0, 0.8), sun=(0.92, 0.70, 0.48), sky=(0.26, 0.28, 0.38), softness=0.008
    ),
    "overcast": Light(sun=(0.30, 0.30, 0.30), sky=(0.62, 0.65, 0.70), softness=0.03),
}

_TILES = ((0.86, 0.85, 0.83), (0.81, 0.80, 0.775))
_EDGE = 0.05


class StackDrawing(Drawing[StackSimulation]):
    """Draws a Panda and two cubes."""

    cameras = CAMERAS
    lights = LIGHTS
    focus = ((0.35, 0.0, 0.25), 0.75)
    ao_radius = 0.05

    def _build(self) -> None:
        floor = plane(6.0, 60, _TILES).moved((0.1, 0.1, 0))
        self.scene.add_mesh(floor, static=True, gloss=0.0)
        self.first_cube = add_panda(self.scene, ARM_ID, GRIPPER_ID)
        for instance in (RED_ID, GREEN_ID):
            self.scene.add_mesh(box(_EDGE / 2, 0.002), instance=instance, gloss=0.15)

    def _dress(self, simulation: StackSimulation, factors: Factors) -> None:
        for cube, color in enumerate(PALETTES[str(factors["colors"])]):
            self.scene.set_color(self.first_cube + cube, color)

    def draw(self, simulation: StackSimulation) -> Frame:
        places, turns = simulation.poses
        turns[self.first_cube :] *= simulation.edge / _EDGE
        return self.scene.render(places, turns)
