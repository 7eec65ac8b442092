"""Tasks: goals to reach in an environment, judged from what a video shows.

A task is registered with its environment (`registry.add(…, tasks={"place": "module:PLACE"})`).
`gymnasium.make("acwm/push_cube-v0", task="place")` returns a `TaskEnvironment` that combines both.
This module does not use torch.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.episode import plain_unit
from acwm_core.env.physics import Observation
from acwm_core.errors import PluginError, RecipeError, check_shape

Frame = NDArray[np.uint8]

MAX_DRAWS = 100
"""How many goals are drawn at most to find one that is not already reached at the start."""


class SolvedAtStartError(RecipeError):
    """Every goal that was drawn for an episode is reached in its first frame."""


class Goal(NamedTuple):
    """One moment in which a task is solved, as the simulator shows it."""

    # state fields of the card, without a time axis, and marks such as a target region
    state: Mapping[str, NDArray[Any]]
    mask: Frame  # instance ids, [H, W]
    frame: Frame  # the picture, [H, W, 3]

    @classmethod
    def now(cls, environment: Environment) -> Goal:
        """The current moment of an environment."""
        frame, info = environment.observe()
        return cls(info["state"], info["mask"], frame)


def observed(infos: Sequence[Mapping[str, Any]]) -> Observation:
    """The simulator's observation of T frames, from the `info` of `reset` and `step`."""
    fields = {n: np.stack([info["state"][n] for info in infos]) for n in infos[0]["state"]}
    return Observation(np.stack([info["mask"] for info in infos]), fields)


class Task(ABC):
    """A goal, distance and success in an environment. A task stores no state of an episode.

    Distance, success and failure are computed from the frames of an `Observation`, made by the
    simulator (`observed`) or by an estimator. They therefore use only what estimators can read,
    and `goal.state`.

    Attributes:
        name: the task's name within its environment.
        summary: a description in one sentence.
        unit: unit of the distance, e.g. ``"m"``.
        tolerance: largest distance that counts as success.
        max_steps: number of actions after which an episode ends.
        avoid: pairs of instances, by their names on the card, that must not touch.
        planning: default settings of planning for this task, e.g. ``("cost=state",)``.
    """

    name: str
    summary: str
    unit: str
    tolerance: float
    max_steps: int
    avoid: tuple[tuple[str, str], ...] = ()
    planning: tuple[str, ...] = ()

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "unit" in vars(cls):
            cls.unit = plain_unit(cls.unit)

    @abstractmethod
    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Draw a goal that can be reached from the state of the environment, which was just reset.

        It may use the simulator freely; the environment is reset again afterwards.
        """

    @abstractmethod
    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """How far each frame is from the goal, `[T]` ≥ 0; NaN where it is unknown.

        It is 0 at the goal and decreases on the way there.
        """

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether each frame shows a failure that no later success makes up for, `[T]`."""
        return np.zeros(len(seen.masks), np.bool_)

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether the goal is reached in each frame, with no failure up to that frame, `[T]`."""
        near = self.distance(seen, goal) <= self.tolerance
        return near & ~np.logical_or.accumulate(self.failed(seen, goal))

    def solution(
        self, environment: Environment, goal: Goal, rng: np.random.Generator
    ) -> Policy | None:
        """A scripted solution from the environment's current state; None if there is none."""
        return None


def judged(task: Task, method: str, seen: Observation, goal: Goal) -> NDArray[Any]:
    """Call `distance`, `failed` or `success` and check its result, one value per frame `[T]`.

    Raises:
        PluginError: the result is not one value per frame.
    """
    values = np.asarray(getattr(task, method)(seen, goal))
    check_shape(task, method, values, len(seen.masks))
    return values


class TaskEnvironment(gymnasium.Wrapper[Frame, NDArray[np.float32], Frame, NDArray[np.float32]]):
    """An environment with a task, which defines the reward, the end of an episode and more `info`.

    The goal of an episode is drawn from the random stream ``goal:TASK`` of its `EpisodeSpec`, and
    drawn again if it is already reached at the start. The reward of a step is minus the distance
    after it. Success ends an episode. A failure does not, because ending early would be rewarded.
    An episode is truncated after `Task.max_steps`. `info` has ``distance``, ``success`` and
    ``failed``; the `info` of `reset` also has ``goal``.

    Attributes:
        environment: the wrapped environment.
        task: the task.
        goal: goal of the running episode.
    """

    goal: Goal

    def __init__(self, environment: Environment, task: Task) -> None:
        super().__init__(environment)
        self.environment, self.task = environment, task
        names = environment.card.instances
        if not isinstance(cast(object, task), Task):
            raise PluginError(
                f"a task of {environment.card.name} is {task!r:.60}, which is not a Task"
            )
        steps = isinstance(task.max_steps, Integral) and task.max_steps >= 1
        near = isinstance(task.tolerance, Real) and task.tolerance >= 0
        if {*task.avoid} - {*itertools.product(names, names)} or not (steps and near):
            raise PluginError(
                f"task {task.name!r} of {environment.card.name} avoids instances that are not on "
                "its card, has no steps or no tolerance"
            )
        self._avoided = {tuple(sorted(map(names.index, pair))) for pair in task.avoid}
        self._steps, self._failed = 0, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Frame, dict[str, Any]]:
        """As `Environment.reset`; `options` may have a ``goal``.

        Raises:
            SolvedAtStartError: every goal drawn was already reached at the start.
        """
        _, info = self.environment.reset(seed=seed, options=options)
        spec = self.environment.episode_spec
        again: dict[str, Any] = {**(options or {}), "spec": spec}
        rng = spec.rng(f"goal:{self.task.name}")
        self._steps, self._failed = 0, False
        for _ in range(MAX_DRAWS):
            self.goal = again.get("goal") or self.task.sample_goal(self.environment, rng)
            frame, info = self.environment.reset(options=again)
            self.judge(info)
            if not info["success"] or "goal" in again:
                return frame, {**info, "goal": self.goal}
        raise SolvedAtStartError(
            f"task {self.task.name!r} is solved at the start of episode {spec.index} of "
            f"{spec.split}, whichever of {MAX_DRAWS} goals is drawn"
        )

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Frame, float, bool, bool, dict[str, Any]]:
        """As `Environment.step`."""
        frame, _, _, _, info = self.environment.step(action)
        self._steps += 1
        self.judge(info)
        over = self._steps >= self.task.max_steps
        return frame, -info["distance"], info["success"], over, info

    def judge(self, info: dict[str, Any]) -> None:
        """Add distance, success and failure to the `info` of the current frame."""
        seen, task, goal = observed([info]), self.task, self.goal
        touched = not self._avoided.isdisjoint(info["contacts"])
        self._failed = self._failed or touched or bool(judged(task, "failed", seen, goal)[0])
        success = bool(judged(task, "success", seen, goal)[0]) and not self._failed
        distance = float(judged(task, "distance", seen, goal)[0])
        if not 0 <= distance < math.inf:  # the simulator knows every state, so NaN is an error
            raise PluginError(
                f"the distance of task {task.name!r} is {distance} in its own states, not a finite "
                "number of at least 0"
            )
        info |= {"distance": distance, "success": success, "failed": self._failed}
