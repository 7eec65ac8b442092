"""Costs of candidates: distance in latent space, distance of states, or a user's own function."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task, judged
from acwm_core.errors import RecipeError, noting
from acwm_core.recipe.trust import import_named
from acwm_planning.planner import Cost, Futures
from acwm_planning.predicted import NotPredicted, PredictedStates

TINY = 1e-6
"""Square of a distance that counts as none, so that a gradient is known there."""


def last_frames(length: int, frames: int | None) -> list[int]:
    """Choose `frames` evenly spaced latent frames of `length`, including the last; None means all.

    Raises:
        RecipeError: `frames` is below 1.
    """
    if frames is not None and frames < 1:
        raise RecipeError(f"cost.frames={frames}: give 1 or more, or null for all")
    count = min(frames or length, length)
    return [length - 1 - (n * length) // count for n in reversed(range(count))]


class LatentDistance(Cost):
    """Mean squared distance between predicted latents and the latent of the still goal image.

    Args:
        frames: number of latent frames to judge, including the last. By default all of them, which
            favours reaching the goal fast, and not only a good final frame.
    """

    observes = False

    def __init__(self, *, frames: int | None = None) -> None:
        self.frames = frames
        last_frames(1, frames)

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`. The unit is squared standard deviations of a latent."""
        latents = futures.latents(last_frames(futures.length, self.frames))
        return (latents - futures.still(goal.frame).to(latents)).square().flatten(1).mean(1)


class StateDistance(Cost):
    """The task's own distance, from states that the model predicts or that are read from frames.

    A model that knows how the states go on is asked for them, and need not draw a picture. Of
    others, and if the task looks at more than the model predicts, the environment's estimator reads
    the predicted frames.

    The mean over the frames in which the distance can be read, and a penalty for the others.
    Objects fade from a prediction when the model is unsure of them: without the penalty, a search
    finds actions that make them fade. A candidate without any known distance gets the largest mean
    of the others (0 if there are no others) and the penalty.

    Args:
        frames: number of latent frames to judge, evenly spaced and including the last; null for
            all. If pictures are read, that takes most of the time.
        read: "model" or "pictures", the only source of states; null for the model's own where they
            are enough.
        failure: added to the cost if the task fails in one of these frames, in tolerances of the
            task.
        unknown: penalty in tolerances of the task, times the share of frames whose distance cannot
            be read.

    Raises:
        RecipeError: a source that is not one of these; `read="model"` of one that does not predict
            what the task looks at.
    """

    judged = True

    def __init__(
        self,
        *,
        frames: int | None = 3,
        read: Literal["model", "pictures"] | None = None,
        failure: float = 10.0,
        unknown: float = 10.0,
    ) -> None:
        if read not in ("model", "pictures", None):
            raise RecipeError(f"cost.read is {read!r}: give model, pictures or null")
        self.frames, self.read, self.failure, self.unknown = frames, read, failure, unknown
        self.carried = read != "pictures"
        last_frames(1, frames)

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`. The unit is the task's tolerance."""
        frames = last_frames(futures.length, self.frames)
        predicted = None if self.read == "pictures" else futures.predicted(frames)
        if predicted is not None:
            try:
                return self._judge(predicted, len(frames), task, goal)
            except NotPredicted:
                if self.read == "model":
                    raise
        elif self.read == "model":
            raise RecipeError("the model predicts no states: set cost.read=pictures")
        return self._judge(futures.observe(frames), len(frames), task, goal)

    def _judge(self, observation: Observation, frames: int, task: Task, goal: Goal) -> Tensor:
        distances = judged(task, "distance", observation, goal).reshape(-1, frames) / task.tolerance
        failed = judged(task, "failed", observation, goal).reshape(-1, frames).any(1)
        finite = np.isfinite(distances)
        if isinstance(observation.states, PredictedStates) and not finite.any():
            # It may know a field in part, such as where a body is and not how high.
            raise NotPredicted(
                "no distance can be computed from what the model predicts: set cost.read=pictures"
            )
        total = np.where(finite, distances, 0).sum(1)
        mean = total / np.maximum(finite.sum(1), 1)
        mean = np.where(finite.any(1), mean, mean.max(initial=0))
        penalty = self.unknown * (1 - finite.mean(1)) + self.failure * failed
        return torch.from_numpy(mean + penalty).float()


class KeypointDistance(Cost):
    """Distance of the model's keypoints from those that it reads in the goal's picture.

    The sum over keypoints of the distance of their places and features, each number weighted by how
    much the picture changes with it; the mean over frames. It needs neither states nor an
    estimator, and the task only for its goal. A keypoint that is not seen does not count.

    Args:
        frames: number of latent frames to judge, evenly spaced and including the last; null for
            all.
        features: weight of what keypoints look like, beside where they are; 0 compares places
            alone.

    Raises:
        RecipeError: a negative weight.
    """

    observes = False

    def __init__(self, *, frames: int | None = 3, features: float = 1.0) -> None:
        if not features >= 0:
            raise RecipeError(f"cost.features is {features}; it must be 0 or more")
        self.frames, self.features = frames, features
        last_frames(1, frames)

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`. The unit is a usual deviation of a keypoint that counts."""
        expected = futures.keypoints(last_frames(futures.length, self.frames))
        wanted = futures.keypoints_of(goal.frame)
        if expected is None or wanted is None:
            raise RecipeError(
                "this model sees no points to compare: take cost=latent, or train one that does, "
                "such as by +points"
            )
        weights = expected.weights.clone()
        weights[:, 2:] *= self.features
        apart = ((expected.values - wanted.values) * weights).nan_to_num(0)
        return (apart.square().sum(-1) + TINY).sqrt().sum(2).mean(1)


class UserCost(Cost):
    """A user's own function: maps ``(futures, task, goal)`` to costs `[N]`.

    Args:
        function: its ``module:name``, importable or in the working directory.

    Raises:
        RecipeError: there is no such function.
    """

    def __init__(self, *, function: str) -> None:
        self.name = function
        self.function = import_named(function, f"cost.function={function}")
        if not callable(self.function):
            raise RecipeError(f"cost.function={function} is not a function")

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`."""
        with noting(f"in cost.function={self.name}", self.function):
            return torch.as_tensor(self.function(futures, task, goal)).float()
