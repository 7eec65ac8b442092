"""Costs of futures: latent distance to the goal's picture, distance of states, and a user's own."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from acwm_core.errors import RecipeError
from acwm_core.errors.plugin_code import WrongResultError, named_by_user
from acwm_core.planning.planner import Cost, Futures
from acwm_core.planning.task import Goal, Task, judged


def last_frames(length: int, frames: int | None) -> list[int]:
    """Which latent frames are judged: so many, evenly spread, the last among them; None is all.

    Raises:
        RecipeError: a number below 1.
    """
    if frames is not None and frames < 1:
        raise RecipeError(f"cost.frames={frames}: give 1 or more, or null for all")
    count = min(frames or length, length)
    return [length - 1 - (place * length) // count for place in reversed(range(count))]


class LatentDistance(Cost):
    """Mean squared distance of latents to that of the goal's picture, standing still.

    Args:
        frames: how many latent frames are judged, the last among them; all by default, which asks
            for a fast way and not only for a good end.
    """

    def __init__(self, *, frames: int | None = None) -> None:
        self.frames = frames
        last_frames(1, frames)

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`; in squared standard deviations of a latent."""
        latents = futures.latents(last_frames(futures.length, self.frames))
        return (latents - futures.still(goal.frame).to(latents)).square().flatten(1).mean(1)


class StateDistance(Cost):
    """The task's own distance, of states read from the pictures by the environment's estimator.

    A frame in which it cannot be told does not count; a candidate of such frames alone is worst.

    Args:
        frames: how many latent frames are judged, evenly spread, the last among them; null for
            all. Each is decoded and read, which takes most of the time.
        failure: what is added for a candidate in which the task fails in one of them, in tolerances
            of the task.
    """

    def __init__(self, *, frames: int | None = 3, failure: float = 10.0) -> None:
        self.frames, self.failure = frames, failure
        last_frames(1, frames)

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`; in tolerances of the task."""
        frames = last_frames(futures.length, self.frames)
        seen = futures.observe(frames)
        distances = judged(task, "distance", seen, goal).reshape(-1, len(frames)) / task.tolerance
        failed = judged(task, "failed", seen, goal).reshape(-1, len(frames)).any(1)
        known = np.isfinite(distances)
        total = np.where(known, distances, 0).sum(1)
        mean = np.where(known.any(1), total / np.maximum(known.sum(1), 1), np.nan)
        return torch.from_numpy(mean + self.failure * failed).float()


class UserCost(Cost):
    """A callable of the user's own: ``(futures, task, goal)`` to costs `[N]`.

    Args:
        function: ``module:name`` of it, importable or in the working directory.

    Raises:
        RecipeError: there is none.
    """

    def __init__(self, *, function: str) -> None:
        self.function = named_by_user(function, f"cost.function={function}")
        if not callable(self.function):
            raise RecipeError(f"cost.function={function} is not a function")

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`."""
        made = torch.as_tensor(self.function(futures, task, goal))
        if made.is_complex():
            raise WrongResultError(self, "cost", made, "real numbers")
        return made.float()
