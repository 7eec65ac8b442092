"""cloth_move: two grippers carry a cloth over a sphere that stands on the ground."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry
from acwm_deformable.cloth import Cloth
from acwm_deformable.cloth_drawing import CLOTH_ID, HAND_ID, SPHERE_ID, ClothDrawing
from acwm_deformable.cloth_policy import Carrier, TwoArms
from acwm_deformable.cloth_start import NODES, hang, sheet_of
from acwm_deformable.states import (
    CLOTH_CAMERA,
    CLOTH_LIGHT,
    CLOTH_MOVE_STATE,
    GRIPPERS,
    NODE_STRIDE,
    VELOCITY_STRIDE,
)
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

MAX_STEP = 0.06
"""Largest movement in metres of a gripper along each axis per frame."""

GRASP, LET_GO = 0.5, -0.5
"""A grasp command above the first value closes a gripper; one below the second opens it."""

_FACTORS = (
    Factor.continuous(
        "cloth_size",
        "side of the square cloth",
        train=(0.60, 0.75),
        ood=((0.42, 0.52), (0.86, 0.96)),
        nominal=0.68,
        unit="m",
        active=True,
    ),
    Factor.discrete(
        "placement",
        "where the cloth hangs at first, seen from the sphere",
        train=("left", "right"),
        ood=("front", "behind"),
        nominal="left",
        active=True,
    ),
    Factor.continuous(
        "stiffness",
        "bending stiffness of the cloth",
        train=(4e-5, 8e-5),
        ood=((1e-6, 5e-6), (4e-4, 1e-3)),
        nominal=6e-5,
        unit="N·m",
    ),
    Factor.continuous(
        "friction",
        "Coulomb friction of the cloth on sphere and ground",
        train=(0.25, 0.35),
        ood=((0.0, 0.05), (0.7, 1.0)),
        nominal=0.3,
    ),
    Factor.continuous(
        "density",
        "mass of the cloth per area",
        train=(0.15, 0.25),
        ood=((0.04, 0.07), (0.5, 0.8)),
        nominal=0.2,
        unit="kg/m²",
    ),
    Factor.continuous(
        "sphere_radius",
        "radius of the sphere",
        train=(0.18, 0.22),
        ood=((0.11, 0.14), (0.26, 0.30)),
        nominal=0.2,
        unit="m",
    ),
    appearance("pattern", "colours of the cloth", "checks", "stripes", "red checks", "plain"),
    LIGHT,
    appearance("camera", "point of view", "front", "side", "high"),
)


_LIMITS = {
    "cloth_size": (0.3, 1.1),
    "stiffness": (1e-7, 1e-2),
    "friction": (0.0, 5.0),
    "density": (0.02, 5.0),
    "sphere_radius": (0.06, 0.32),
}
"""The factor values that the simulation accepts."""


_MIRROR = Symmetry(
    (-1, 2, 3),
    mirrored=True,
    repainted=("cloth",),  # its bright and its dark side change places
)


class ClothMove(SceneEnvironment[Cloth]):
    """Two grippers hold a cloth by two corners and carry it over a sphere.

    The action is one displacement (Δx, Δy, Δz) in metres for both grippers: +x is right in the
    frame, +y away from the viewer, +z up. They move at constant speed and stop together at the
    sphere, the ground and the edge of their workspace, and where the cloth would have to stretch.
    The rest of a stopped motion is dropped.
    """

    drawn_by = ClothDrawing
    limits = _LIMITS
    card = EnvironmentCard(
        name="cloth_move",
        summary="Two grippers carry a cloth over a fixed sphere.",
        action=ActionSpec(
            names=("dx", "dy", "dz"),
            units=("m", "m", "m"),
            low=(-MAX_STEP,) * 3,
            high=(MAX_STEP,) * 3,
            kind="delta",
        ),
        frame_size=(240, 240),
        fps=10,
        horizon=64,
        factors=_FACTORS,
        ood_shifts=("cloth_size", "placement"),
        state=CLOTH_MOVE_STATE,
        instances=("ground", "sphere", "cloth", *GRIPPERS),
        engine="Taichi (XPBD)",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        variants=("cloth_move_8d",),
        citation="ACWM-Phys, arXiv:2605.08567",
        symmetries=(_MIRROR,),
        camera=CLOTH_CAMERA,
        light=CLOTH_LIGHT,
    )
    together = True
    longest_step = MAX_STEP

    def _begin(self, factors: Factors, rng: np.random.Generator) -> Cloth:
        sheet = sheet_of(
            float(factors["cloth_size"]),
            density=float(factors["density"]),
            stiffness=float(factors["stiffness"]),
            friction=float(factors["friction"]),
            sphere=float(factors["sphere_radius"]),
        )
        return hang(sheet, str(factors["placement"]), rng, together=self.together)

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move grippers and cloth as a whole, and rotate them about the vertical."""
        self.simulation.displace(amount * rng.normal(0, 1e-3, 2), amount * rng.normal(0, 1e-3))

    def _transform(self, symmetry: Symmetry) -> None:
        self.simulation.mirror()

    def _advance(self, action: NDArray[np.float32]) -> None:
        self.simulation.advance(np.tile(action, (2, 1)), 1 / self.card.fps)

    def _state(self) -> dict[str, NDArray[Any]]:
        cloth = self.simulation
        nodes = cloth.nodes.reshape(NODES, NODES, 3)
        speeds = cloth.velocities.reshape(NODES, NODES, 3)
        return {
            "cloth_position": nodes[::NODE_STRIDE, ::NODE_STRIDE].astype(np.float16),
            "cloth_velocity": speeds[::VELOCITY_STRIDE, ::VELOCITY_STRIDE].astype(np.float16),
            "cloth_size": np.array(self._factors["cloth_size"], np.float32),
            "gripper_position": cloth.hands.copy(),
            "gripper_holds": (cloth.held >= 0).astype(np.float32),
            "sphere_position": cloth.sphere_center.astype(np.float32),
            "sphere_radius": np.array(cloth.sheet.sphere, np.float32),
        }

    def _contacts(self) -> Iterable[tuple[int, int]]:
        cloth = self.simulation
        on_sphere, on_ground, *hands_on_sphere = cloth.touched.tolist()
        if on_sphere:
            yield SPHERE_ID, CLOTH_ID
        if on_ground:
            yield 0, CLOTH_ID
        for k, (touches, node) in enumerate(zip(hands_on_sphere, cloth.held, strict=True)):
            if touches:
                yield SPHERE_ID, HAND_ID + k
            if node >= 0:
                yield CLOTH_ID, HAND_ID + k

    def policy(self, rng: np.random.Generator) -> Policy:
        """Mostly carry the cloth over, onto and past the sphere, otherwise wander or rest."""
        carrier = Carrier(self.simulation, MAX_STEP, rng)
        return lambda: carrier.next_steps()[0]


class ClothMove8D(ClothMove):
    """cloth_move with two independent arms, which can release the cloth and grasp it again.

    The action is (Δx, Δy, Δz, grasp) per arm. A grasp above 0.5 grasps the nearest node of the
    cloth within 5 cm and pulls it in; a grasp below −0.5 releases it; values in between (such as
    zero) change nothing. Arms that both hold the cloth stop each other where it is taut.
    """

    card = replace(
        ClothMove.card,
        name="cloth_move_8d",
        summary="Two arms that can part and let go carry a cloth over a fixed sphere.",
        action=ActionSpec(
            names=tuple(f"{part}_{arm}" for arm in (1, 2) for part in ("dx", "dy", "dz", "grasp")),
            units=("m", "m", "m", "") * 2,
            low=(-MAX_STEP, -MAX_STEP, -MAX_STEP, -1.0) * 2,
            high=(MAX_STEP, MAX_STEP, MAX_STEP, 1.0) * 2,
            kind="delta",
        ),
        variants=(),
        symmetries=(replace(_MIRROR, actions=(-1, 2, 3, 4, -5, 6, 7, 8)),),
    )
    together = False

    def _advance(self, action: NDArray[np.float32]) -> None:
        arms = action.reshape(2, 4)
        for hand, grasp in enumerate(arms[:, 3].tolist()):
            if grasp > GRASP:
                self.simulation.grasp(hand)
            elif grasp < LET_GO:
                self.simulation.release(hand)
        self.simulation.advance(arms[:, :3], 1 / self.card.fps)

    def policy(self, rng: np.random.Generator) -> Policy:
        """The policy of cloth_move, plus moves of single arms, drops and catches."""
        arms = TwoArms(self.simulation, MAX_STEP, rng)

        def act() -> NDArray[np.float64]:
            steps = arms.next_steps()
            return np.column_stack([steps, arms.grasp]).ravel()

        return act
