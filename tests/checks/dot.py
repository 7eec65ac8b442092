"""An environment that conforms: a dot that velocity actions move about. Flaws are added to it."""

from typing import ClassVar

import numpy as np

from acwm_core.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.episode import Factor

GAIN = Factor.continuous(
    "gain", "speed", train=(0.8, 1.0), ood=((1.5, 2.0),), nominal=0.9, active=True
)
SHADE = Factor.discrete("shade", "look", train=("light",), ood=("dark",), nominal="light")


class Dot(Environment):
    card: ClassVar = EnvironmentCard(
        name="dot",
        summary="A dot that moves as told.",
        action=ActionSpec(("dx", "dy"), ("m/s", "m/s"), (-1.0, -1.0), (1.0, 1.0), "delta"),
        frame_size=(128, 192),
        fps=10,
        horizon=12,
        factors=(GAIN, SHADE),
        ood_shifts=("gain", "shade"),
        state=(StateField("position", (2,), "m", "from the middle"),),
        instances=("background", "dot"),
        engine="numpy",
    )

    def _start(self, factors, rng):
        self.gain, self.shade = factors["gain"], factors["shade"]
        self.position = rng.uniform(-0.2, 0.2, 2)

    def _advance(self, action):
        self.position = np.clip(self.position + self.gain * action / self.card.fps, -0.4, 0.4)

    def _render(self):
        height, width = self.frame_size
        y, x = np.indices(self.frame_size) + 0.5
        x, y = (x - width / 2) / height, (y - height / 2) / height
        distance = np.hypot(x - self.position[0], y - self.position[1]) - 0.1
        covered = np.clip(0.5 - distance * height, 0, 1)[..., None]
        sky = 200 if self.shade == "light" else 60
        frame = (sky + covered * (np.array([220, 40, 40]) - sky)).astype(np.uint8)
        return frame, (distance < 0).astype(np.uint8)

    def _state(self):
        return {"position": self.position.copy()}

    def _contacts(self):
        return [(0, 1)] if np.abs(self.position).max() >= 0.4 else []

    def policy(self, rng):
        return lambda: rng.uniform(-1, 1, 2)
