"""The `Driver` interface: who solves a task while a person watches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.task import Frame, Goal


class Driver(ABC):
    """Solves a task in a simulator of which it sees pictures only.

    It is created with `world_model`, the `card` of the simulator, `task`, `action_std` (standard
    deviation `[A]` of the raw actions that the model was trained on, or None) and `steps` (sampling
    steps, or None for the model's own number).
    """

    @abstractmethod
    def begin(self, goal: Goal, still: NDArray[np.float32], seed: int) -> None:
        """Aim at a goal from now on. `still` is the raw action `[A]` that means no motion now."""

    @abstractmethod
    def act(
        self,
        frames: Sequence[Frame],
        actions: Sequence[NDArray[np.float32]],
        check: Callable[[], None],
    ) -> Sequence[NDArray[np.float32]]:
        """The next raw actions, `[A]` each, at least one.

        Args:
            frames: the last frames, `[H, W, 3]` each, up to now.
            actions: the raw actions between them, `[A]` each.
            check: to be called often; it raises once the decision has been cancelled.
        """
