"""Any Gymnasium environment as an `Environment`: its own simulator, pictures, observations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from PIL import Image

from acwm_core.env.environment import Environment, EnvironmentCard, Policy
from acwm_core.env.episode import FactorValue

GymEnv = gymnasium.Env[Any, Any]

OBSERVATION = "observation"
"""The state field of an observation that is one vector; those of a dict have their own names."""

HELD = (2, 7)
"""Between how many frames the policy holds an action."""


class GymnasiumWorld(Environment):
    """A Gymnasium environment that renders ``rgb_array``, frame by frame.

    A subclass sets `card` and `make`, as ``acwm new environment NAME --from-gym ID`` writes them.
    It may override `_state` to name what the simulator knows, and every other method. An episode
    goes on where the environment itself would end. Frames have no masks, contacts are unknown.
    """

    card: EnvironmentCard

    def __init__(self, **params: Any) -> None:
        super().__init__(**params)
        self.gym = type(self).make().unwrapped
        self._seen: Any = None

    @staticmethod
    def make() -> GymEnv:
        """Make the environment, e.g. ``gymnasium.make("Pendulum-v1", render_mode="rgb_array")``."""
        raise NotImplementedError

    def _start(self, factors: Mapping[str, FactorValue], rng: np.random.Generator) -> None:
        self._seen, _ = self.gym.reset(seed=int(rng.integers(2**31)))

    def _advance(self, action: NDArray[np.float32]) -> None:
        space = self.gym.action_space
        taken: Any = int(action.argmax()) if isinstance(space, Discrete) else action
        if isinstance(space, Box):
            taken = np.clip(action.reshape(space.shape).astype(space.dtype), space.low, space.high)
        self._seen = self.gym.step(taken)[0]

    def _render(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        picture = np.asarray(self.gym.render())
        return resized(picture, self.frame_size), np.zeros(self.frame_size, np.uint8)

    def _state(self) -> dict[str, NDArray[Any]]:
        parts = self._seen if isinstance(self._seen, Mapping) else {OBSERVATION: self._seen}
        return {f.name: np.array(parts[f.name]).reshape(f.shape) for f in self.card.state}

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return ()

    def policy(self, rng: np.random.Generator) -> Policy:
        """Random actions, each held for some frames."""
        low, high = np.array(self.card.action.low), np.array(self.card.action.high)
        chooses = isinstance(self.gym.action_space, Discrete)

        def actions() -> Iterator[NDArray[np.float64]]:
            while True:
                action = rng.uniform(low, high)
                if chooses:
                    action = np.eye(len(low))[rng.integers(len(low))]
                for _ in range(rng.integers(*HELD)):
                    yield action

        return actions().__next__


def resized(picture: NDArray[Any], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture `[H, W, 3]` cut to the proportions of a frame, in its middle, and resized."""
    height, width = picture.shape[:2]
    scale = min(height / size[0], width / size[1])
    rows, columns = round(size[0] * scale), round(size[1] * scale)
    top, left = (height - rows) // 2, (width - columns) // 2
    cut = np.ascontiguousarray(picture[top : top + rows, left : left + columns, :3], np.uint8)
    return np.asarray(Image.fromarray(cut).resize((size[1], size[0]), Image.Resampling.BOX))
