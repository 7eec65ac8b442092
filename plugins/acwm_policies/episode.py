"""What comes of a policy in an episode, told from what is seen: success, return, distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.episode import EpisodeSpec
from acwm_core.estimator import Observation
from acwm_core.planning.task import Frame, Goal, Task
from acwm_core.planning.task import judged as told


@dataclass(frozen=True)
class Start:
    """Where policies begin.

    Attributes:
        spec: of the episode.
        frames: that a model is given, the last one of now, `[K, H, W, 3]`; nothing moves in them.
        actions: raw actions between them, `[K − 1, A]`.
        goal: of the episode.
        distance: true one from the goal.
    """

    spec: EpisodeSpec
    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    goal: Goal
    distance: float


@dataclass(frozen=True)
class Outcome:
    """What came of an episode.

    Attributes:
        success: whether the task was solved.
        returns: minus the sum of the distances after each action, until success.
        steps: actions until success, or all of them.
        distance: after the last of those.
        unread: whether no frame tells the distance, which then stays as at the start.
    """

    success: bool
    returns: float
    steps: int
    distance: float
    unread: bool = False

    def facts(self) -> dict[str, Any]:
        """JSON-ready."""
        return dict(vars(self))


def outcome(distances: NDArray[np.float64], success: NDArray[np.bool_], start: Start) -> Outcome:
    """What T frames after the start come to.

    Args:
        distances: of each, `[T]`; where one cannot be told, it stays as it was before.
        success: of each, `[T]`.
        start: of the episode.
    """
    known = np.concatenate([[start.distance], distances])
    last = np.maximum.accumulate(np.where(np.isfinite(known), np.arange(len(known)), 0))
    steps = int(success.argmax()) + 1 if success.any() else len(success)
    told = known[last][1 : steps + 1]
    unread = not np.isfinite(distances).any()
    return Outcome(bool(success.any()), -float(told.sum()), steps, float(told[-1]), unread)


def judged(seen: Observation, task: Task, start: Start) -> Outcome:
    """What T frames come to that an estimator has read."""
    distances, success = (told(task, each, seen, start.goal) for each in ("distance", "success"))
    return outcome(distances.astype(np.float64), success, start)


@dataclass(frozen=True)
class Played:
    """An episode in the true simulator.

    Attributes:
        frames: after each action, `[H, W, 3]` each.
        actions: raw, `[T, A]`.
        outcome: by the simulator's own word.
    """

    frames: list[Frame]
    actions: NDArray[np.float32]
    outcome: Outcome


def joined(parts: list[Observation]) -> Observation:
    """Observations one after another in time."""
    states: Mapping[str, NDArray[Any]] = {
        name: np.concatenate([part.states[name] for part in parts]) for name in parts[0].states
    }
    return Observation(np.concatenate([part.masks for part in parts]), states)
