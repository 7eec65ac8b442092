"""Tasks: what is to be reached in an environment, told from what a video shows.

A task is registered with its environment (`registry.add(…, tasks={"place": "module:PLACE"})`).
`gymnasium.make("acwm/push_cube-v0", task="place")` makes a `TaskEnvironment` of both. Numpy only.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import Environment, Policy
from acwm_core.errors import PluginError, RecipeError
from acwm_core.errors.plugin_code import WrongResultError, numbers
from acwm_core.estimator import Observation

Frame = NDArray[np.uint8]

MAX_DRAWS = 100
"""How many goals are drawn until one is not reached at the start already."""


class Goal(NamedTuple):
    """One moment in which a task is solved, as the simulator shows it."""

    state: Mapping[str, NDArray[Any]]  # fields of the card, no axis of time; marks, e.g. a region
    mask: Frame  # [H, W] instance ids
    frame: Frame  # [H, W, 3] its picture

    @classmethod
    def now(cls, environment: Environment) -> Goal:
        """The present moment of an environment."""
        frame, info = environment.observe()
        return cls(info["state"], info["mask"], frame)


def observed(infos: Sequence[Mapping[str, Any]]) -> Observation:
    """What the simulator says of T frames, from the `info` of `reset` and `step`."""
    fields = {n: np.stack([info["state"][n] for info in infos]) for n in infos[0]["state"]}
    return Observation(np.stack([info["mask"] for info in infos]), fields)


class Task(ABC):
    """What is to be reached in an environment. It holds nothing of an episode.

    Distance, success and failure are measured in the frames of an `Observation`: the simulator's
    own (`observed`), or what a `StateEstimator` reads in a video, predicted or not. So they use
    only fields (and masks) that the environment's estimator reads, and constants of `goal.state`.

    Attributes:
        name: what it is called in its environment.
        summary: one sentence.
        unit: of the distance, e.g. ``"m"``.
        tolerance: largest distance that counts as success.
        max_steps: actions after which an episode is over.
        avoid: pairs of instances, by their names on the card, that may not touch.
    """

    name: str
    summary: str
    unit: str
    tolerance: float
    max_steps: int
    avoid: tuple[tuple[str, str], ...] = ()

    @abstractmethod
    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """A goal that can be reached from where the environment is, which was just reset.

        It may use the simulator as it likes; the environment is reset again afterwards.
        """

    @abstractmethod
    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """How far each frame is from the goal, `[T]` ≥ 0; NaN where that cannot be told.

        It is 0 in the goal itself and falls on the way there.
        """

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Frames `[T]` in which something happened that no later success makes good."""
        return np.zeros(len(seen.masks), np.bool_)

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Frames `[T]` in which the goal is reached, and nothing has failed in a frame so far."""
        near = self.distance(seen, goal) <= self.tolerance
        return near & ~np.logical_or.accumulate(self.failed(seen, goal))

    def solution(
        self, environment: Environment, goal: Goal, rng: np.random.Generator
    ) -> Policy | None:
        """A scripted solution that starts where the environment is; None if there is none."""
        return None


def judged(task: Task, method: str, seen: Observation, goal: Goal) -> NDArray[Any]:
    """What `distance`, `failed` or `success` says of each frame, `[T]`.

    Raises:
        WrongResultError: it is no number, or no truth value, for each.
    """
    made = getattr(task, method)(seen, goal)
    found = numbers(task, method, made, len(seen.masks))
    if method != "distance" and found.dtype != np.bool_:
        raise WrongResultError(task, method, made, "true or false for each frame")
    return found


class TaskEnvironment(gymnasium.Wrapper[Frame, NDArray[np.float32], Frame, NDArray[np.float32]]):
    """An environment with a task, from which its reward, its end and parts of its info come.

    The goal of an episode is drawn from the stream ``goal:TASK`` of its `EpisodeSpec`, again if it
    is reached at the start. The reward of a step is minus the distance after it. Success ends an
    episode, so that a high return is a fast one; a failure does not, as that would pay. It is
    truncated after `Task.max_steps`, whatever the card's horizon. `info` has ``distance``,
    ``success`` and ``failed``; that of `reset` has ``goal``, too.

    Attributes:
        environment: what it wraps.
        task: the task.
        goal: of the running episode.
    """

    goal: Goal

    def __init__(self, environment: Environment, task: Task) -> None:
        super().__init__(environment)
        self.environment, self.task = environment, task
        names = environment.card.instances
        if not isinstance(cast(object, task), Task):
            raise PluginError(
                f"a task of {environment.card.name} is {task!r:.60}, which is no Task"
            )
        if {*task.avoid} - {*itertools.product(names, names)} or not task.max_steps >= 1:
            raise PluginError(
                f"task {task.name!r} of {environment.card.name} avoids instances that are not on "
                "its card, or has no steps"
            )
        self._avoided = {tuple(sorted(map(names.index, pair))) for pair in task.avoid}
        self._steps, self._failed = 0, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Frame, dict[str, Any]]:
        """As `Environment.reset`; options may have a ``goal``. `RecipeError`: none can be drawn."""
        _, info = self.environment.reset(seed=seed, options=options)
        spec = self.environment.episode_spec
        again: dict[str, Any] = {**(options or {}), "spec": spec}
        rng = spec.rng(f"goal:{self.task.name}")
        self._steps, self._failed = 0, False
        for _ in range(MAX_DRAWS):
            goal: Any = again.get("goal") or self.task.sample_goal(self.environment, rng)
            if not isinstance(goal, Goal):
                raise WrongResultError(self.task, "sample_goal", goal, "a Goal")
            self.goal = goal
            frame, info = self.environment.reset(options=again)
            self._judge(info)
            if not info["success"] or "goal" in again:
                return frame, {**info, "goal": self.goal}
        raise RecipeError(f"task {self.task.name!r} is solved at the start of every episode here")

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Frame, float, bool, bool, dict[str, Any]]:
        """As `Environment.step`."""
        frame, _, _, _, info = self.environment.step(action)
        self._steps += 1
        self._judge(info)
        over = self._steps >= self.task.max_steps
        return frame, -info["distance"], info["success"], over, info

    def _judge(self, info: dict[str, Any]) -> None:
        seen, task, goal = observed([info]), self.task, self.goal
        touched = not self._avoided.isdisjoint(info["contacts"])
        self._failed = self._failed or touched or bool(judged(task, "failed", seen, goal)[0])
        success = bool(judged(task, "success", seen, goal)[0]) and not self._failed
        distance = float(judged(task, "distance", seen, goal)[0])
        info |= {"distance": distance, "success": success, "failed": self._failed}
