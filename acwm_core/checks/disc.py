"""A world that needs no simulator: a disc that velocity actions move about."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import ActionSpec, Environment, EnvironmentCard, Policy, StateField
from acwm_core.episode import Factor, FactorValue

RADIUS = 0.1  # of the frame's height, which is 1 m
WALL = 0.25  # m from the middle

GAIN = Factor.continuous(
    "gain", "speed at an action of 1", train=(0.8, 1.0), ood=((1.5, 2.0),), nominal=0.9, active=True
)
SHADE = Factor.discrete("shade", "background", train=("light",), ood=("dark",), nominal="light")


class Disc(Environment):
    """What metrics are tried on if their own plugin brings no environment."""

    card = EnvironmentCard(
        name="disc",
        summary="A disc that moves as told.",
        action=ActionSpec(("vx", "vy"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "delta"),
        frame_size=(128, 192),
        fps=10,
        horizon=24,
        factors=(GAIN, SHADE),
        ood_shifts=("gain", "shade"),
        state=(
            StateField("position", (2,), "m", "from the middle of the frame, y down"),
            StateField("bearing", (), "rad", "direction of the position, from x to y"),
        ),
        instances=("background", "disc"),
        engine="numpy",
    )

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self.gain, self.shade = float(factors["gain"]), factors["shade"]
        self.position = rng.uniform(-0.2, 0.2, 2)

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        self.position = self.position + amount * rng.normal(0, 1e-3, 2)

    def _advance(self, action: NDArray[np.float32]) -> None:
        self.position = np.clip(self.position + self.gain * action / self.card.fps, -WALL, WALL)

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        height, width = self.frame_size
        y, x = np.indices(self.frame_size) + 0.5
        x, y = (x - width / 2) / height, (y - height / 2) / height
        distance = np.hypot(x - self.position[0], y - self.position[1]) - RADIUS
        covered = np.clip(0.5 - distance * height, 0, 1)[..., None]
        background = 200 if self.shade == "light" else 60
        frame = background + covered * (np.array([220, 40, 40]) - background)
        return frame.astype(np.uint8), (distance < 0).astype(np.uint8)

    def _state(self) -> dict[str, NDArray[Any]]:
        x, y = self.position
        return {"position": self.position.copy(), "bearing": np.arctan2(y, x)}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return [(0, 1)] if np.abs(self.position).max() >= WALL else []

    def policy(self, rng: np.random.Generator) -> Policy:
        """Velocities at random."""
        return lambda: rng.uniform(-1, 1, 2)
