"""push_rope: an upright pole pushes a flexible rope on a table."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Symmetry
from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.rope import POLE_ROOM, Cord, Rope
from acwm_deformable.rope_curves import lay_rope
from acwm_deformable.rope_drawing import POLE_ID, ROPE_ID, RopeDrawing
from acwm_deformable.rope_policy import Pusher
from acwm_deformable.states import PUSH_ROPE_STATE, ROPE_CAMERA
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

MAX_STEP = 0.06
"""Largest step of the pole along an axis in one frame, metres."""

_FACTORS = (
    Factor.continuous(
        "length",
        "length of the rope",
        train=(2.0, 2.8),
        ood=((3.1, 3.1),),
        nominal=2.4,
        unit="m",
        active=True,
    ),
    Factor.continuous(
        "stiffness",
        "bending stiffness of the rope",
        train=(0.03, 0.07),
        ood=((0.002, 0.006), (0.3, 0.5)),
        nominal=0.05,
        unit="N·m²",
    ),
    Factor.continuous(
        "friction",
        "Coulomb friction of the rope on the table",
        train=(0.4, 0.6),
        ood=((0.15, 0.25), (1.0, 1.4)),
        nominal=0.5,
    ),
    Factor.continuous(
        "thickness",
        "diameter of the rope",
        train=(0.064, 0.076),
        ood=((0.042, 0.05), (0.095, 0.11)),
        nominal=0.07,
        unit="m",
    ),
    appearance("colors", "colours of rope and pole", "red", "green", "pastel"),
    LIGHT,
    appearance("camera", "where the scene is seen from", "front", "top", "corner"),
)

_LIMITS = {
    "length": (1.0, 3.3),
    "stiffness": (0.0, 5.0),
    "friction": (0.02, 5.0),
    "thickness": (0.042, 0.15),
}
"""The factor values that the simulation accepts."""

_MIRROR = Symmetry((-1, 2), mirrored=True)


class PushRope(SceneEnvironment[Rope]):
    """A rope on a table and an upright pole that pushes it and is never lifted.

    The action moves the pole in the plane of the table at constant speed: ``delta_x`` along the
    world's +x (right), ``delta_z`` along +y (away from the front camera). The names come from the
    paper, where y is up; here z is up. The pole stops at the edge of a rectangle in view.
    """

    drawn_by = RopeDrawing
    limits = _LIMITS
    card = EnvironmentCard(
        name="push_rope",
        summary="An upright pole pushes a flexible rope about a table.",
        action=ActionSpec(
            names=("delta_x", "delta_z"),
            units=("m", "m"),
            low=(-MAX_STEP, -MAX_STEP),
            high=(MAX_STEP, MAX_STEP),
            kind="delta",
        ),
        frame_size=(240, 240),
        fps=10,
        horizon=64,
        factors=_FACTORS,
        ood_shifts=("length",),
        state=PUSH_ROPE_STATE,
        instances=("table", "rope", "pole"),
        engine="Taichi (XPBD)",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        symmetries=(_MIRROR,),
        camera=ROPE_CAMERA,
    )

    longest_step = MAX_STEP

    def _begin(self, factors: Factors, rng: np.random.Generator) -> Rope:
        rope = lay_rope(_cord(factors), rng)
        rope.pole[:] = _beside(rope, rng)
        self._pole_velocity = np.zeros(2)
        return rope

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move rope and pole, and rotate the rope as a whole, so it neither bends nor stretches."""
        rope, shift, turn = self.simulation, amount * rng.normal(0, 1e-3, 4), rng.normal(0, 1e-3)
        middle = rope.nodes.mean(0, dtype=np.float64)
        c, s = np.cos(amount * turn), np.sin(amount * turn)
        arms = (rope.nodes - middle) @ np.array([[c, s], [-s, c]])
        rope.nodes[:] = middle + arms + shift[:2]
        rope.pole[:] = np.clip(rope.pole + shift[2:], np.negative(POLE_ROOM), POLE_ROOM)

    def _transform(self, symmetry: Symmetry) -> None:
        self.simulation.nodes[:, 0] *= -1
        self.simulation.pole[0] *= -1

    def _advance(self, action: NDArray[np.float32]) -> None:
        before = self.simulation.pole.astype(np.float64)
        self.simulation.advance(action, 1 / self.card.fps)
        self._pole_velocity = (self.simulation.pole - before) * self.card.fps

    def _state(self) -> dict[str, NDArray[Any]]:
        rope = self.simulation
        segments = np.diff(rope.nodes.astype(np.float64), axis=0)
        state = {
            "rope_position": rope.nodes,
            "rope_velocity": rope.velocities,
            "rope_length": np.linalg.norm(segments, axis=1).sum(keepdims=True),
            "pole_position": rope.pole,
            "pole_velocity": self._pole_velocity,
        }
        return {name: np.array(value, np.float32) for name, value in state.items()}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return ((ROPE_ID, POLE_ID),) if self.simulation.touched else ()

    def policy(self, rng: np.random.Generator) -> Policy:
        """Mostly push the rope at chosen points, otherwise wander or pause."""
        return Pusher(self.simulation, MAX_STEP, rng).next_move


def _cord(factors: Factors) -> Cord:
    """The rope of an episode."""
    return Cord(
        float(factors["length"]),
        radius=float(factors["thickness"]) / 2,
        stiffness=float(factors["stiffness"]),
        friction=float(factors["friction"]),
    )


def _beside(rope: Rope, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a position [2] in metres for the pole that is near the rope but does not touch it."""
    touch = POLE_RADIUS + rope.cord.radius
    while True:
        place = rng.uniform(np.negative(POLE_ROOM), POLE_ROOM)
        gap = np.linalg.norm(rope.nodes - place, axis=1).min() - touch
        if 0.04 < gap < 0.25:
            return place
