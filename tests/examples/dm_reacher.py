"""dm_control's reacher as an environment of acwm: a world that was not made for it.

Physics, model and camera are those of `dm_control.suite`; frames are drawn here, as its own need
OpenGL. The card declares what the states are and where the camera is, and nothing else is told to
anybody.
"""

import numpy as np
from dm_control import suite

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry

HEIGHT = 0.01  # of all that moves, metres

CARD = EnvironmentCard(
    name="dm_reacher",
    summary="dm_control's arm of two links, whose finger reaches for a target.",
    action=ActionSpec(("shoulder", "wrist"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "torque"),
    frame_size=(64, 64),
    fps=10,
    horizon=40,
    factors=(
        Factor.continuous(
            "target_radius",
            "radius of the target",
            train=(0.04, 0.06),
            ood=((0.01, 0.02),),
            nominal=0.05,
            unit="m",
            active=True,
        ),
    ),
    ood_shifts=("target_radius",),
    state=(
        StateField("joint_angle", (2,), "rad", "shoulder and wrist", "angle", ("arm", "hand")),
        StateField("joint_velocity", (2,), "rad/s", "shoulder and wrist"),
        StateField(
            "finger_position",
            (2,),
            "m",
            "x right, y up",
            "position",
            ("finger",),
            height=HEIGHT,
            follows=("joint_angle",),
        ),
        StateField(
            "target_position", (2,), "m", "x right, y up", "position", ("target",), height=HEIGHT
        ),
    ),
    instances=("floor", "target", "arm", "hand", "finger"),
    engine="dm_control (MuJoCo)",
    symmetries=(Symmetry((-1, -2), mirrored=True, states={"joint_velocity": (-1, -2)}),),
    camera=Camera(eye=(0, 0, 0.75), up=(0, 1, 0), fov=45),
)

COLOURS = np.array([[60, 80, 110], [220, 80, 80], [200, 170, 90], [160, 190, 100], [240, 240, 240]])


class DmReacher(Environment):
    """Starts at rest at random joint angles, with the target at a random place."""

    card = CARD

    def __init__(self, **params):
        super().__init__(**params)
        self.suite = suite.load("reacher", "easy")
        self.physics = self.suite.physics

    def _start(self, factors, rng):
        self.radius = float(factors["target_radius"])
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.06, 0.2)
        self.target = far * np.array([np.cos(angle), np.sin(angle)])
        self._begin(rng.uniform([-np.pi, -2.5], [np.pi, 2.5]))

    def _begin(self, angles):
        self.physics.reset()
        self.physics.named.model.geom_size["target", 0] = self.radius
        self.physics.named.model.geom_pos["target", :2] = self.target
        self.physics.data.qpos[:] = angles
        self.physics.forward()

    def _perturb(self, amount, rng):
        self._begin(self.physics.data.qpos + amount * rng.normal(0, 1e-3, 2))

    def _transform(self, symmetry):
        shoulder, wrist = self.physics.data.qpos
        self.target = self.target * [-1, 1]
        self._begin([np.pi - shoulder, -wrist])

    def _advance(self, action):
        self.physics.set_control(action)
        self.physics.step(round(1 / self.card.fps / self.physics.timestep()))

    def _places(self, *names):
        return [self.physics.named.data.geom_xpos[name, :2].copy() for name in names]

    def _render(self):
        height, width = self.frame_size
        model = self.physics.model
        half = (model.cam_pos[0, 2] - HEIGHT) * np.tan(np.radians(model.cam_fovy[0]) / 2)
        pixel = 2 * half / height
        y, x = np.indices(self.frame_size) + 0.5
        points = np.stack([x - width / 2, height / 2 - y], -1) * pixel
        arm, hand, finger = self._places("arm", "hand", "finger")
        elbow, tip = 2 * arm, 2 * hand - 2 * arm
        parts = (
            np.linalg.norm(points - self.target, axis=-1) - self.radius,
            _from_rod(points, np.zeros(2), elbow),
            _from_rod(points, elbow, tip),
            np.linalg.norm(points - finger, axis=-1) - 0.015,
        )
        frame, mask = (
            np.broadcast_to(COLOURS[0], (*self.frame_size, 3)),
            np.zeros(self.frame_size, np.uint8),
        )
        for instance, distance in enumerate(parts, 1):
            covered = np.clip(0.5 - distance / pixel, 0, 1)[..., None]
            frame = frame + covered * (COLOURS[instance] - frame)
            mask[distance < 0] = instance
        return frame.round().astype(np.uint8), mask

    def _state(self):
        (finger,) = self._places("finger")
        wrapped = (self.physics.data.qpos + np.pi) % (2 * np.pi) - np.pi
        return {
            "joint_angle": wrapped,
            "joint_velocity": self.physics.data.qvel.copy(),
            "finger_position": finger,
            "target_position": self.target.copy(),
        }

    def _contacts(self):
        return ()

    def policy(self, rng):
        def torques():
            while True:
                torque = rng.uniform(-1, 1, 2)
                for _ in range(rng.integers(3, 9)):
                    yield torque

        return torques().__next__


def _from_rod(points, start, end):
    """Distance of points from a rod of 1 cm radius."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)[..., None]
    return np.linalg.norm(points - start - share * along, axis=-1) - 0.01
