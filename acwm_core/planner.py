"""The `Planner` and `Cost` interfaces: what chooses actions, and what tells good futures from bad."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from acwm_core.estimator import Observation
from acwm_core.shapes import Actions, Latent, Video
from acwm_core.task import Frame, Goal, Task

RolloutCost = Callable[[Actions], Tensor]
"""What N candidates `[N, T, A]` of raw actions cost, `[N]`; it has a gradient if they have one."""


@dataclass(frozen=True)
class Plan:
    """What a planner decided: raw actions `[T, A]`, the cost it expects of them, and its effort."""

    actions: Tensor
    cost: float
    evaluations: int  # candidates that were rolled out


class Planner(ABC):
    """Finds the actions that cost least. It sees their cost alone, neither model nor simulator.

    One instance plans one episode at a time and may keep what helps its next decision.

    Attributes:
        actions_per_plan: actions that are taken before it is asked again.
    """

    actions_per_plan: int

    @abstractmethod
    def plan(
        self, cost: RolloutCost, low: Tensor, high: Tensor, generator: torch.Generator
    ) -> Plan:
        """The best actions that it finds within the bounds `low` and `high`, both `[A]`.

        A cost of NaN counts as worst. Whatever is random comes from `generator`, on the CPU.
        """

    def reset(self) -> None:
        """Forget earlier decisions; called when an episode starts."""


class Futures(ABC):
    """Where N candidates lead, by a model or the simulator; worked out when it is asked for.

    Frame 0 is the first latent frame after now, frame `length` − 1 the last one planned.
    """

    length: int

    @abstractmethod
    def latents(self, frames: Sequence[int]) -> Latent:
        """Latents of these frames, `[N, len(frames), C, h, w]`."""

    @abstractmethod
    def video(self, frames: Sequence[int]) -> Video:
        """The last picture of each of these frames, `[N, len(frames), 3, H, W]`."""

    @abstractmethod
    def observe(self, frames: Sequence[int]) -> Observation:
        """What these pictures show, of all candidates in turn: `[N · len(frames), …]`."""

    @abstractmethod
    def still(self, picture: Frame) -> Latent:
        """The latent frame of a picture `[H, W, 3]` that stands still, `[1, 1, C, h, w]`."""


class Cost(ABC):
    """How far futures are from what a task asks for."""

    @abstractmethod
    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """A cost per candidate, `[N]`: less is better, and NaN is worst."""
