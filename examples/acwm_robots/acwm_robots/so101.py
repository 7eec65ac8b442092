"""so101-nexus: the arm that many owners of LeRobot have, beside a cube."""

from typing import Any

import gymnasium
import numpy as np
import so101_nexus_mujoco  # noqa: F401  it registers its environments
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_sim.gymnasium_world import GymnasiumWorld

SUBSTEPS = 5
"""Steps of the environment, which has 50 in a second, per frame; they take the same action."""

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

CARD = EnvironmentCard(
    name="so101_cube",
    summary="A SO-101 arm beside a cube.",
    action=ActionSpec(
        names=JOINTS,
        units=("rad",) * 6,
        low=(-1.91986, -1.74533, -1.69, -1.65806, -2.74385, -0.17453),
        high=(1.91986, 1.74533, 1.69, 1.65806, 2.84121, 1.74533),
        kind="absolute",
    ),
    frame_size=(96, 128),
    fps=10,
    horizon=41,
    factors=(),
    ood_shifts=(),
    state=(
        StateField("joint_position", (6,), "rad", "of the joints and the gripper"),
        StateField("cube_position", (3,), "m", "of its middle"),
        StateField("cube_quaternion", (4,), "", "w first"),
    ),
    instances=("unlabelled",),
    engine="so101-nexus-mujoco 0.2.0 (MuJoCo)",
)


class SO101Cube(GymnasiumWorld):
    """`MuJoCoPickCubeLift-v1`."""

    card = CARD

    @staticmethod
    def make() -> gymnasium.Env:
        """See `GymnasiumWorld.make`."""
        return gymnasium.make("MuJoCoPickCubeLift-v1", render_mode="rgb_array")

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self.gym.reset(seed=0)
        self.gym.render()  # the first picture of a renderer differs a little from later ones

    def _advance(self, action: NDArray[np.float32]) -> None:
        for _ in range(SUBSTEPS):
            super()._advance(action)

    def _state(self) -> dict[str, NDArray]:
        model, data = self.gym.model, self.gym.data
        joints = [data.qpos[model.joint(name).qposadr[0]] for name in JOINTS]
        cube = data.body("cube")
        parts = (np.array(joints), cube.xpos.copy(), cube.xquat.copy())
        return dict(zip((field.name for field in CARD.state), parts, strict=True))
