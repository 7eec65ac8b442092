"""The outcome of a policy in an episode, from what is seen: success, return and distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation
from acwm_core.env.task import Frame, Goal, Task, judged


@dataclass(frozen=True)
class Start:
    """The start of an episode, from which policies act.

    Attributes:
        spec: spec of the episode.
        frames: context frames for a model, `[K, H, W, 3]`; nothing moves in them, and the last one
            is the current frame.
        actions: raw actions between the frames, `[K − 1, A]`.
        goal: goal of the episode.
        distance: true distance from the goal.
    """

    spec: EpisodeSpec
    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    goal: Goal
    distance: float


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
    distances: NDArray[np.float64], success: NDArray[np.bool_], start: Start
) -> Outcome:
    """Compute the outcome of the T frames after the start.

    Args:
        distances: distance in each frame, `[T]`. One that is not finite is replaced by the last
            finite one.
        success: whether each frame shows success, `[T]`.
        start: start of the episode.
    """
    known = np.concatenate([[start.distance], distances])
    last = np.maximum.accumulate(np.where(np.isfinite(known), np.arange(len(known)), 0))
    steps = int(success.argmax()) + 1 if success.any() else len(success)
    counted = known[last][1 : steps + 1]
    unread = not np.isfinite(distances).any()
    return Outcome(bool(success.any()), -float(counted.sum()), steps, float(counted[-1]), unread)


def read_outcome(seen: Observation, task: Task, start: Start) -> Outcome:
    """Compute the outcome of T frames that an estimator has read."""
    distances, success = (judged(task, each, seen, start.goal) for each in ("distance", "success"))
    return compute_outcome(distances.astype(np.float64), success, start)


@dataclass(frozen=True)
class PolicyEpisode:
    """An episode that was played in the true simulator.

    Attributes:
        frames: the frame after each action, `[H, W, 3]` each.
        actions: raw actions, `[T, A]`.
        outcome: outcome from the simulator's true states.
    """

    frames: list[Frame]
    actions: NDArray[np.float32]
    outcome: Outcome


def join_observations(parts: list[Observation]) -> Observation:
    """Concatenate observations in time."""
    states: Mapping[str, NDArray[Any]] = {
        name: np.concatenate([part.states[name] for part in parts]) for name in parts[0].states
    }
    return Observation(np.concatenate([part.masks for part in parts]), states)
