"""The environment: a card and the methods that every environment implements."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, Policy, StateField
from acwm_core.env.episode import Factor, FactorValue
from acwm_pusht.arena import RADIUS, SIDE, Arena
from acwm_pusht.policy import Pusher

REACH = 50.0
"""The farthest pull on the agent, px: held, it moves by 20 px a frame."""

CARD = EnvironmentCard(
    name="pusht",
    summary="A disc pushes a T onto its place in a square arena, seen from above.",
    action=ActionSpec(
        ("pull_x", "pull_y"), ("px", "px"), (-REACH, -REACH), (REACH, REACH), "delta"
    ),
    frame_size=(96, 96),
    fps=10,
    horizon=61,
    factors=(
        Factor.continuous(
            "scale",
            "width of the T's bars",
            train=(28.0, 32.0),
            ood=((20.0, 24.0), (36.0, 40.0)),
            nominal=30.0,
            unit="px",
        ),
        Factor.continuous(
            "damping",
            "share of its speed that the T keeps after a second",
            train=(0.0, 0.02),
            ood=((0.3, 0.6),),
            nominal=0.0,
        ),
    ),
    ood_shifts=("scale", "damping"),
    state=(
        StateField(
            "agent",
            (2,),
            "px",
            "centre of the disc; x right, y down, of 512",
            kind="position",
            instances=("agent",),
        ),
        StateField("velocity", (2,), "px/s", "its velocity", kind="vector", instances=("agent",)),
        StateField(
            "block",
            (2,),
            "px",
            "origin of the T, in the middle of its bar's upper edge",
            kind="position",
            instances=("block",),
        ),
        StateField(
            "angle",
            (),
            "rad",
            "of the T, clockwise in the picture, from 0 to 2π",
            kind="angle",
            instances=("block",),
            axis=(0, 0, 1),  # away from the viewer, as y points down
        ),
        StateField(
            "corners",
            (8, 2),
            "px",
            "of the T's two bars, four each",
            kind="position",
            instances=("block",),
            follows=("block", "angle"),
        ),
    ),
    instances=("background", "wall", "goal", "block", "agent"),
    engine="gym-pusht 0.1.8 (Pymunk)",
    episodes={"train": 10_000, "ind_test": 256, "ood_test": 256},
    citation="Chi et al. 2023, Diffusion Policy, arXiv:2303.04137",
    camera=Camera.flat(SIDE / 2, (SIDE / 2, SIDE / 2), down=True),
)


class PushT(Environment):
    """Starts as gym-pusht does, with the disc clear of the T. An action is relative to the disc."""

    card = CARD

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self.arena = Arena(float(factors["scale"]), float(factors["damping"]))
        low, high = (50, 50, 100, 100, -np.pi), (450, 450, 400, 400, np.pi)
        while not self.arena.start(rng.uniform(low, high)):
            pass

    def _advance(self, action: NDArray[np.float32]) -> None:
        target = np.array(self.arena.agent.position) + action.astype(np.float64)
        self.arena.move(np.clip(target, RADIUS, SIDE - RADIUS))  # no wall stops the disc

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        return self.arena.picture(self.frame_size)

    def _state(self) -> dict[str, NDArray[Any]]:
        agent, block = self.arena.agent, self.arena.block
        return {
            "agent": np.array(agent.position),
            "velocity": np.array(agent.velocity),
            "block": np.array(block.position),
            "angle": np.array(block.angle % (2 * np.pi)),
            "corners": self.arena.corners(),
        }

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return self.arena.touching

    def policy(self, rng: np.random.Generator) -> Policy:
        """Pushes from all sides, and random pulls."""
        return Pusher(self.arena, REACH, rng).pulls().__next__
