"""Gymnasium's Reacher as an environment of acwm: a world that was not made for it.

Physics and model are those of `gymnasium.envs.mujoco`; frames are drawn here, as its own need
OpenGL.
The card alone declares what the states are and where the camera is.
"""

import gymnasium
import mujoco
import numpy as np

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry

HEIGHT = 0.01  # of all that moves, metres

CARD = EnvironmentCard(
    name="gymnasium_reacher",
    summary="Gymnasium's arm of two links, whose finger reaches for a target.",
    action=ActionSpec(("shoulder", "wrist"), ("", ""), (-0.05,) * 2, (0.05,) * 2, "torque"),
    frame_size=(64, 64),
    fps=10,
    horizon=20,
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
    engine="Gymnasium (MuJoCo)",
    symmetries=(Symmetry((-1, -2), mirrored=True, states={"joint_velocity": (-1, -2)}),),
    camera=Camera(eye=(0, 0, 0.75), up=(0, 1, 0), fov=45),
)

COLOURS = np.array([[60, 80, 110], [220, 80, 80], [200, 170, 90], [160, 190, 100], [240, 240, 240]])


class GymnasiumReacher(Environment):
    """Starts at rest at random joint angles, with the target at a random place."""

    card = CARD

    def __init__(self, **params):
        super().__init__(**params)
        self.reacher = gymnasium.make("Reacher-v5").unwrapped
        self.model, self.data = self.reacher.model, self.reacher.data

    def _start(self, factors, rng):
        self.radius = float(factors["target_radius"])
        angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(0.06, 0.2)
        target = far * np.array([np.cos(angle), np.sin(angle)])
        self._begin(rng.uniform([-np.pi, -2.5], [np.pi, 2.5]), target)

    def _begin(self, angles, target):
        mujoco.mj_resetData(self.model, self.data)
        self.model.geom("target").size[0] = self.radius
        self.reacher.set_state(np.concatenate([angles, target]), np.zeros(4))

    def _perturb(self, amount, rng):
        angles, target = np.split(self.data.qpos.copy(), 2)
        self._begin(angles + amount * rng.normal(0, 1e-3, 2), target)

    def _transform(self, symmetry):
        shoulder, wrist, x, y = self.data.qpos
        self._begin([np.pi - shoulder, -wrist], [-x, y])

    def _advance(self, action):
        self.reacher.do_simulation(action, round(1 / self.card.fps / self.model.opt.timestep))

    def _place(self, body):
        return self.data.body(body).xpos[:2].copy()

    def _render(self):
        height, width = self.frame_size
        half = (CARD.camera.eye[2] - HEIGHT) * np.tan(np.radians(CARD.camera.fov) / 2)
        pixel = 2 * half / height
        y, x = np.indices(self.frame_size) + 0.5
        points = np.stack([x - width / 2, height / 2 - y], -1) * pixel
        target, elbow, finger = map(self._place, ("target", "body1", "fingertip"))
        parts = (
            np.linalg.norm(points - target, axis=-1) - self.radius,
            _from_rod(points, np.zeros(2), elbow),
            _from_rod(points, elbow, finger),
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
        return {
            "joint_angle": (self.data.qpos[:2] + np.pi) % (2 * np.pi) - np.pi,
            "joint_velocity": self.data.qvel[:2].copy(),
            "finger_position": self._place("fingertip"),
            "target_position": self._place("target"),
        }

    def _contacts(self):
        return ()

    def policy(self, rng):
        def torques():
            while True:
                torque = rng.uniform(CARD.action.low, CARD.action.high)
                for _ in range(rng.integers(3, 9)):
                    yield torque

        return torques().__next__


def _from_rod(points, start, end):
    """Distance of points from a rod of 1 cm radius."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)[..., None]
    return np.linalg.norm(points - start - share * along, axis=-1) - 0.01
