"""The `Planner` and `Cost` interfaces: what chooses actions, and what tells which are good."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from acwm_core.estimator import Observation
from acwm_core.planning.task import Frame, Goal, Task
from acwm_core.shapes import Actions, Latent, Video

RolloutCost = Callable[[Actions], Tensor]
"""What N candidates `[N, T, A]` of raw actions cost, `[N]`; NaN is worst."""


@dataclass(frozen=True)
class Plan:
    """Raw actions `[T, A]`, what they are expected to cost, and how many candidates it took."""

    actions: Tensor
    cost: float
    evaluations: int


class Planner(ABC):
    """Finds the actions that cost least; may keep what helps its next decision in an episode."""

    actions_per_plan: int  # that are taken before it plans again

    @abstractmethod
    def reset(self) -> None:
        """Forget earlier decisions, as an episode starts."""

    @abstractmethod
    def plan(self, cost: RolloutCost, low: Tensor, high: Tensor, rng: torch.Generator) -> Plan:
        """The best actions found within bounds `[A]`; all randomness comes from `rng`, on the CPU.

        It may ask `cost` of actions that require a gradient.
        """


class Futures(ABC):
    """Where N candidates lead; frames are the `length` planned latent frames, 0 the next one."""

    length: int

    @abstractmethod
    def latents(self, frames: Sequence[int]) -> Latent:
        """Latents of some frames, `[N, len(frames), C, h, w]`."""

    @abstractmethod
    def video(self, frames: Sequence[int]) -> Video:
        """The last picture of each, `[N, len(frames), 3, H, W]`."""

    @abstractmethod
    def observe(self, frames: Sequence[int]) -> Observation:
        """What these pictures show, of all candidates in turn, `[N · len(frames), …]`."""

    @abstractmethod
    def still(self, picture: Frame) -> Latent:
        """The latent frame of a picture that stands still, `[1, 1, C, h, w]`."""


class Cost(ABC):
    """How far futures are from what a task asks for."""

    @abstractmethod
    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """A cost per candidate, `[N]`, the less the better; NaN is worst."""
