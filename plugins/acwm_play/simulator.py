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
"""Number of scenes to draw from."""


@dataclass(frozen=True)
class Scene:
    """The start of a world: an episode of the training split, with other factors if requested.

    Attributes:
        index: number of the episode.
        factors: values of factors by name; the episode draws the other factors.
    """

    index: int
    factors: Mapping[str, FactorValue] = field(default_factory=dict[str, FactorValue])

    @classmethod
    def drawn(cls, factors: Mapping[str, FactorValue]) -> Scene:
        """Draw a random scene with these factors."""
        return cls(secrets.randbelow(SCENES), factors)


@dataclass(frozen=True)
class Moment:
    """Everything that the simulator knows about one frame.

    Attributes:
        frame: `[H, W, 3]` uint8.
        mask: `[H, W]` uint8 instance ids.
        state: the state fields of the card.
        contacts: pairs of instance ids that touch.
        factors: the value of every factor.
        ood_label: the factors whose values lie outside the training range, or None.
        action: the raw action `[A]` that led to this frame; zeros at the start.
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
        environment: registered name of the environment.
        size: height and width of frames.
    """

    def __init__(self, environment: str, size: tuple[int, int]) -> None:
        self.environment: Environment = make_environment(environment, {"size": list(size)})
        self.card = self.environment.card
        self._policy: Policy | None = None
        self._spec = EpisodeSpec(self.card.name)
        self._takeovers = 0

    def start(self, scene: Scene, frames: int = 1) -> list[Moment]:
        """Build a scene and hold still for `frames` frames, as many as a model is given.

        Raises:
            RecipeError: the environment does not have such a factor or value.
        """
        spec = EpisodeSpec(self.card.name, "train", scene.index, factors=dict(scene.factors))
        with blaming(f"in scene {scene.index}", self.environment):
            frame, info = self.environment.reset(options={"spec": spec})
        self._spec, self._policy = spec, None
        moments = [_moment(frame, info, np.zeros(self.card.action.size, np.float32))]
        return moments + [self.step(self.still()) for _ in range(frames - 1)]

    def step(self, action: NDArray[np.float32]) -> Moment:
        """Advance by one frame; the action is clipped to its bounds."""
        action_spec = self.card.action
        low, high = (np.asarray(b, np.float32) for b in (action_spec.low, action_spec.high))
        taken = np.clip(np.nan_to_num(np.asarray(action, np.float32)), low, high)
        with blaming("while playing", self.environment):
            frame, _, _, _, info = self.environment.step(taken)
        return _moment(frame, info, taken)

    def still(self) -> NDArray[np.float32]:
        """The action that means no motion."""
        return self.environment.still_action()

    def step_by_policy(self, anew: bool) -> Moment:
        """Advance by one frame with the behaviour policy; `anew` restarts the policy from here."""
        with blaming("while its policy drives", self.environment):
            if self._policy is None or anew:
                self._takeovers += 1
                rng = self._spec.rng(f"play:{self._takeovers}")
                self._policy = self.environment.policy(rng)
            action = np.asarray(self._policy(), np.float32)
        return self.step(action)

    def close(self) -> None:
        """Free the environment's resources."""
        self.environment.close()


def _moment(
    frame: NDArray[np.uint8], info: Mapping[str, Any], action: NDArray[np.float32]
) -> Moment:
    names = ("mask", "state", "contacts", "factors", "ood_label")
    return Moment(frame, **{name: info[name] for name in names}, action=action)
