"""A tiny environment without a simulator: a square that moves by its action.

Importable by spawned workers; `plugin` registers it as ``square``.
"""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import Factor
from acwm_core.plugins import hookimpl

SIDE = 4

FREE = 4
"""Episodes of a split that are made also while the file that SQUARE_GATE names is there."""


class Square(Environment):
    """A square on a grey background; instance 1 is the square, 2 the wall it may touch."""

    card = EnvironmentCard(
        name="square",
        summary="a square that moves by its action",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-2.0, -2.0), (2.0, 2.0), "delta"),
        frame_size=(32, 32),
        fps=10,
        horizon=21,
        factors=(
            Factor.discrete("colour", "grey value", train=(200, 220), ood=(90,), nominal=200),
            Factor.continuous("speed", "gain", train=(0.5, 1.0), ood=((1.5, 2.0),), nominal=1.0),
        ),
        ood_shifts=("colour", "speed"),
        state=(StateField("position", (2,), "px", "of the square's centre"),),
        instances=("background", "square", "wall"),
        engine="numpy",
        episodes={"train": 100, "ind_test": 10, "ood_test": 20},
    )

    def __init__(self, *, size=None, render_mode="rgb_array", fail_at=None, called="square"):
        super().__init__(size=size, render_mode=render_mode)
        self.card = replace(self.card, name=called)
        self._fail_at = fail_at

    def _start(self, factors, rng):
        self._gain, self._colour = factors["speed"], factors["colour"]
        self._noise = rng.integers(0, 60, (*self.frame_size, 3)).astype(np.uint8)
        self._position = rng.uniform(SIDE, np.array(self.frame_size) - SIDE)

    def _advance(self, action):
        gate = Path(os.environ.get("SQUARE_GATE", ""))
        while self._spec.index >= FREE and gate.is_file():  # a test keeps it closed
            time.sleep(0.005)
        if self._fail_at == self._spec.index:
            raise ZeroDivisionError("the square is out of paint")
        limit = np.array(self.frame_size) - SIDE / 2
        self._position = np.clip(self._position + self._gain * action, SIDE / 2, limit)

    def _render(self):
        row, column = (self._position - SIDE / 2).astype(int)
        frame, mask = self._noise.copy(), np.zeros(self.frame_size, np.uint8)
        frame[row : row + SIDE, column : column + SIDE] = self._colour
        mask[row : row + SIDE, column : column + SIDE] = 1
        return frame, mask

    def _state(self):
        return {"position": self._position.copy()}

    def _contacts(self):
        at_wall = np.any(self._position <= SIDE / 2)
        return [(2, 1)] if at_wall else []

    def policy(self, rng):
        return lambda: rng.uniform(-2, 2, 2)


class plugin:
    """Registers the square and variants that misbehave."""

    @staticmethod
    @hookimpl
    def register_environments(registry):
        target = "square_world:Square"
        registry.add("square", target, summary="a moving square")
        registry.add("gated_square", target, called="gated_square")
        registry.add("failing_square", target, fail_at=5, called="failing_square")
        registry.add("renamed_square", target)
        registry.add("no_square", "builtins:dict")
