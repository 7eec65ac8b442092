"""OGBench's `cube-single`: a UR5e arm with a gripper, beside a cube."""

from collections.abc import Mapping

import gymnasium
import mujoco
import numpy as np
import ogbench  # noqa: F401  it registers its environments
from dm_control.mujoco.wrapper.mjbindings.sizes import array_sizes
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.env.episode import FactorValue
from acwm_sim.gymnasium_world import GymnasiumWorld

# dm_control 1.0.50 looks for arrays that MuJoCo 4 no longer has.
for struct, owner in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
    array_sizes[struct] = {k: v for k, v in array_sizes[struct].items() if hasattr(owner, k)}

ACTIONS = ("x", "y", "z", "yaw", "gripper")

FIELDS = {
    "joint_position": "proprio/joint_pos",
    "hand_position": "proprio/effector_pos",
    "gripper_opening": "proprio/gripper_opening",
    "cube_position": "privileged/block_0_pos",
    "cube_quaternion": "privileged/block_0_quat",
}
"""Names on the card, and those of OGBench."""

CARD = EnvironmentCard(
    name="ogbench_cube",
    summary="A UR5e arm beside a cube.",
    action=ActionSpec(
        ("x", "y", "z", "yaw", "gripper"), ("",) * 5, (-1.0,) * 5, (1.0,) * 5, "delta"
    ),
    frame_size=(96, 96),
    fps=20,
    horizon=61,
    factors=(),
    ood_shifts=(),
    state=(
        StateField("joint_position", (6,), "rad", "of the arm"),
        StateField("hand_position", (3,), "m", "between the fingers"),
        StateField("gripper_opening", (1,), "", "from 0, open, to 1"),
        StateField("cube_position", (3,), "m", "of its middle"),
        StateField("cube_quaternion", (4,), "", "w first"),
    ),
    instances=("unlabelled",),
    engine="ogbench 1.2.2 (MuJoCo)",
    citation="Park et al. 2024, OGBench, arXiv:2410.20092",
)


class OGBenchCube(GymnasiumWorld):
    """`cube-single-v0`."""

    card = CARD

    @staticmethod
    def make() -> gymnasium.Env:
        """See `GymnasiumWorld.make`."""
        return gymnasium.make("cube-single-v0", render_mode="rgb_array", width=192, height=192)

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        task = {"task_id": int(rng.integers(1, 6))}  # else it takes one by NumPy's global state
        self._seen, _ = self.gym.reset(seed=int(rng.integers(2**31)), options=task)

    def _state(self) -> dict[str, NDArray]:
        seen = self.gym.compute_ob_info()
        return {name: np.array(seen[key], float) for name, key in FIELDS.items()}
