"""The `Planner` and `Cost` interfaces: what chooses actions, and what rates them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from acwm_core.env.card import EnvironmentCard
from acwm_core.env.physics import Observation
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.model.dynamics import Keypoints
from acwm_core.model.shapes import Actions, Latent, Video

RolloutCost = Callable[[Actions], Tensor]
"""Maps N candidate sequences of raw actions `[N, T, A]` to costs `[N]`; NaN is worst."""


@dataclass(frozen=True)
class Plan:
    """Raw actions `[T, A]`, their expected cost, and how many candidates were evaluated."""

    actions: Tensor
    cost: float
    evaluations: int


class Planner(ABC):
    """Finds the actions of lowest cost; it may keep state between the decisions of an episode."""

    actions_per_plan: int  # how many actions are executed before it plans again

    @abstractmethod
    def reset(self) -> None:
        """Forget earlier decisions; called when an episode starts."""

    @abstractmethod
    def plan(self, cost: RolloutCost, low: Tensor, high: Tensor, rng: torch.Generator) -> Plan:
        """Return the best actions found within the bounds `low` and `high`, each `[A]`.

        All randomness comes from `rng`, on the CPU. `cost` may be called with actions that require
        a gradient.
        """


class Futures(ABC):
    """Predicted futures of N candidates.

    `frames` are indices into the `length` planned latent frames; 0 is the next frame.
    """

    length: int

    @property
    def encoding(self) -> str:
        """Name of the latents, see `Codec.latents_fingerprint`; empty if it is unknown."""
        return ""

    @abstractmethod
    def latents(self, frames: Sequence[int]) -> Latent:
        """Latents of these frames, `[N, len(frames), C, h, w]`."""

    @abstractmethod
    def video(self, frames: Sequence[int]) -> Video:
        """The last video frame of each of these latent frames, `[N, len(frames), 3, H, W]`."""

    @abstractmethod
    def observe(self, frames: Sequence[int]) -> Observation:
        """What these frames show, candidate after candidate, `[N · len(frames), …]`."""

    def predicted(self, frames: Sequence[int]) -> Observation | None:
        """The model's predicted states of these frames, as an observation; None if it has none.

        No picture is made. States that it does not predict raise `NotPredicted` when accessed.
        """
        return None

    def keypoints(self, frames: Sequence[int]) -> Keypoints | None:
        """Where the model expects things in these frames, `[N, len(frames), K, D]`; None if it sees
        none. No picture is made."""
        return None

    def keypoints_of(self, picture: Frame) -> Keypoints | None:
        """Where the model sees things in a picture, `[1, 1, K, D]`; None if it sees none."""
        return None

    @abstractmethod
    def still(self, picture: Frame) -> Latent:
        """The latent frame of a video that repeats `picture`, `[1, 1, C, h, w]`."""


class Cost(ABC):
    """Rates the distance of futures from the goal of a task.

    Attributes:
        observes: whether it may ask for what futures show (`Futures.observe`), which an estimator
            reads in their pictures; it then differs through the codec.
        carried: whether it takes states that the model carries on, where there are some, so that
            planning starts from `state_past`.
        judged: whether only a task with a known goal, and no picture of one, tells it what is near.
    """

    observes: bool = True
    carried: bool = False
    judged: bool = False

    @abstractmethod
    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """Return a cost per candidate, `[N]`; lower is better, NaN is worst."""

    def check(self, card: EnvironmentCard) -> None:  # noqa: B027 (most are of any environment)
        """Refuse to plan in an environment, whose card this is.

        Raises:
            RecipeError: the cost is of another environment.
        """

    def about(self) -> Mapping[str, str]:
        """What it depends on beside its parameters, by name; results keep and show it."""
        return {}
