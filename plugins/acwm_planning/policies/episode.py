"""The outcome of a policy in an episode, from what is seen: success, return and distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.physics import Observation
from acwm_core.env.task import Task, judged
from acwm_planning.episode import EpisodeResult, EpisodeStart


@dataclass(frozen=True)
class Outcome:
    """The outcome of an episode.

    Attributes:
        success: whether the task was solved.
        returns: minus the sum of the distances after each action, until success.
        steps: number of actions until success, or of all actions.
        distance: distance after the last of these actions.
        unread: whether the distance could not be read in any frame. It then stays as at the start.
    """

    success: bool
    returns: float
    steps: int
    distance: float
    unread: bool = False

    def facts(self) -> dict[str, Any]:
        """The attributes, ready for JSON."""
        return dict(vars(self))


def compute_outcome(
    distances: NDArray[np.float64], success: NDArray[np.bool_], start: EpisodeStart
) -> Outcome:
    """Compute the outcome of the T frames after the start.

    Args:
        distances: distance in each frame, `[T]`. One that is not finite is replaced by the last
            finite one.
        success: whether each frame shows success, `[T]`.
        start: start of the episode.
    """
    values = np.concatenate([[start.distance], distances])
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    steps = int(success.argmax()) + 1 if success.any() else len(success)
    counted = values[last][1 : steps + 1]
    unread = not np.isfinite(distances).any()
    return Outcome(bool(success.any()), -float(counted.sum()), steps, float(counted[-1]), unread)


def read_outcome(observation: Observation, task: Task, start: EpisodeStart) -> Outcome:
    """Compute the outcome of T frames that an estimator has read."""
    distances, success = (
        judged(task, method, observation, start.goal) for method in ("distance", "success")
    )
    return compute_outcome(distances.astype(np.float64), success, start)


def true_outcome(result: EpisodeResult, start: EpisodeStart) -> Outcome:
    """Compute the outcome of an episode that was played in the true simulator."""
    distances = np.array(result.distances[1:], np.float64)
    return compute_outcome(distances, np.array(result.successes), start)


def join_observations(parts: list[Observation]) -> Observation:
    """Concatenate observations in time."""
    states: Mapping[str, NDArray[Any]] = {
        name: np.concatenate([part.states[name] for part in parts]) for name in parts[0].states
    }
    return Observation(np.concatenate([part.masks for part in parts]), states)
