"""dm_control's cart-pole: its card, which declares the scene, and the methods of an environment."""

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when dm_control is imported

import mujoco
import numpy as np
from dm_control import suite
from dm_control.mujoco.wrapper.mjbindings.sizes import array_sizes
from numpy.typing import NDArray

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, Policy, StateField
from acwm_core.env.episode import Factor, FactorValue
from acwm_sim.gymnasium_world import resized

# dm_control 1.0.50 looks for arrays that MuJoCo 4 no longer has.
for struct, owner in (("mjmodel", mujoco.MjModel), ("mjdata", mujoco.MjData)):
    array_sizes[struct] = {k: v for k, v in array_sizes[struct].items() if hasattr(owner, k)}

CARD = EnvironmentCard(
    name="dmc_cartpole",
    summary="A cart that swings a pole, of the DeepMind Control Suite.",
    action=ActionSpec(("push",), ("",), (-1.0,), (1.0,), "torque"),
    frame_size=(96, 128),
    fps=20,
    horizon=41,
    factors=(
        Factor.continuous(
            "force",
            "of a full action",
            train=(9.0, 11.0),
            ood=((4.0, 6.0),),
            nominal=10.0,
            unit="N",
        ),
    ),
    ood_shifts=("force",),
    state=(
        StateField("cart", (3,), "m", "its middle", "position", ("cart",)),
        StateField("angle", (), "rad", "from upright", "angle", ("pole",), axis=(0, 1, 0)),
        StateField("velocity", (2,), "", "of the cart, m/s, and of the angle, rad/s"),
        StateField(
            "tip", (3,), "m", "end of the pole", "position", ("pole",), follows=("cart", "angle")
        ),
    ),
    instances=("background", "cart", "pole"),
    engine="dm_control 1.0.50 (MuJoCo)",
    citation="Tassa et al. 2018, DeepMind Control Suite, arXiv:1801.00690",
    camera=Camera(eye=(0, -4, 1), target=(0, 0, 1), fov=45),
)


class CartPole(Environment):
    """Starts at rest, with the cart and the pole at random."""

    card = CARD

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self.physics = suite.load("cartpole", "swingup").physics
        self.steps = round(1 / CARD.fps / self.physics.timestep())

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self.physics.model.actuator_gear[0, 0] = float(factors["force"])
        with self.physics.reset_context():
            self.physics.data.qpos[:] = rng.uniform([-1.0, -np.pi], [1.0, np.pi])

    def _advance(self, action: NDArray[np.float32]) -> None:
        self.physics.set_control(action)
        self.physics.step(self.steps)

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        height, width = self.frame_size
        frame = self.physics.render(
            2 * height, 2 * width, "fixed", render_flag_overrides={"shadow": 0, "reflection": 0}
        )
        geoms = self.physics.render(height, width, "fixed", segmentation=True)[..., 0]
        ids = [self.physics.model.name2id(name, "geom") for name in ("cart", "pole_1")]
        mask = (geoms == ids[0]) + 2 * (geoms == ids[1])
        return resized(frame, self.frame_size), mask.astype(np.uint8)

    def _state(self) -> dict[str, NDArray[Any]]:
        data = self.physics.data
        cart = self.physics.named.data.geom_xpos["cart"].copy()
        angle = (data.qpos[1] + np.pi) % (2 * np.pi) - np.pi
        tip = cart + np.array([np.sin(angle), 0, np.cos(angle)])
        return {"cart": cart, "angle": angle, "velocity": data.qvel.copy(), "tip": tip}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return ()

    def policy(self, rng: np.random.Generator) -> Policy:
        """Random forces, each held for some frames."""

        def forces() -> Iterator[NDArray[np.float64]]:
            while True:
                force = rng.uniform(-1, 1, 1)
                for _ in range(rng.integers(2, 7)):
                    yield force

        return forces().__next__
