"""The simulator of a session, one frame at a time."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.simulate import make_environment
from acwm_core.environment import Environment, Policy
from acwm_core.episode import EpisodeSpec, FactorValue
from acwm_core.errors.plugin_code import blaming

SCENES = 100_000
"""Scenes that are drawn from."""


@dataclass(frozen=True)
class Scene:
    """Where a world starts: an episode of the training split, under other factors where asked.

    Attributes:
        index: of the episode.
        factors: settings of factors by name; the others are as the episode draws them.
    """

    index: int
    factors: Mapping[str, FactorValue] = field(default_factory=dict[str, FactorValue])

    @classmethod
    def drawn(cls, factors: Mapping[str, FactorValue]) -> Scene:
        """Any one, under the same factors."""
        return cls(secrets.randbelow(SCENES), factors)


@dataclass(frozen=True)
class Moment:
    """All that the simulator knows of one frame.

    Attributes:
        frame: `[H, W, 3]` uint8.
        mask: `[H, W]` uint8 instance ids.
        state: the card's state fields.
        contacts: pairs of instance ids.
        factors: the value of every factor.
        ood_label: which of them lie outside training, or None.
        action: the raw action `[A]` that led here; zeros at the start.
    """

    frame: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    state: Mapping[str, NDArray[Any]]
    contacts: tuple[tuple[int, int], ...]
    factors: Mapping[str, FactorValue]
    ood_label: str | None
    action: NDArray[np.float32]


class Simulator:
    """A live environment.

    Args:
        environment: registered name.
        size: height and width of frames.
    """

    def __init__(self, environment: str, size: tuple[int, int]) -> None:
        self.environment: Environment = make_environment(environment, {"size": list(size)})
        self.card = self.environment.card
        self._policy: Policy | None = None
        self._spec = EpisodeSpec(self.card.name)
        self._takeovers = 0

    def start(self, scene: Scene, frames: int = 1) -> list[Moment]:
        """Build a scene and hold still for so many frames: as many as a model is given.

        Raises:
            RecipeError: a factor or value that the environment does not have.
        """
        spec = EpisodeSpec(self.card.name, "train", scene.index, factors=dict(scene.factors))
        with blaming(f"in scene {scene.index}", self.environment):
            frame, info = self.environment.reset(options={"spec": spec})
        self._spec, self._policy = spec, None
        moments = [_moment(frame, info, np.zeros(self.card.action.size, np.float32))]
        return moments + [self.step(self.still()) for _ in range(frames - 1)]

    def step(self, action: NDArray[np.float32]) -> Moment:
        """The next frame, under an action that is clipped to its bounds."""
        action_spec = self.card.action
        low, high = (np.asarray(b, np.float32) for b in (action_spec.low, action_spec.high))
        taken = np.clip(np.nan_to_num(np.asarray(action, np.float32)), low, high)
        with blaming("while playing", self.environment):
            frame, _, _, _, info = self.environment.step(taken)
        return _moment(frame, info, taken)

    def still(self) -> NDArray[np.float32]:
        """The action that asks for no motion."""
        return self.environment.still_action()

    def step_by_policy(self, anew: bool) -> Moment:
        """The next frame, as the behaviour policy wants it; `anew` it begins with what it finds."""
        with blaming("while its policy drives", self.environment):
            if self._policy is None or anew:
                self._takeovers += 1
                rng = self._spec.rng(f"play:{self._takeovers}")
                self._policy = self.environment.policy(rng)
            action = np.asarray(self._policy(), np.float32)
        return self.step(action)

    def close(self) -> None:
        """Free what the environment holds."""
        self.environment.close()


def _moment(
    frame: NDArray[np.uint8], info: Mapping[str, Any], action: NDArray[np.float32]
) -> Moment:
    names = ("mask", "state", "contacts", "factors", "ood_label")
    return Moment(frame, **{name: info[name] for name in names}, action=action)
