"""One episode of a task, played in the true simulator by a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, EnvironmentCard, Policy
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import noting
from acwm_core.plugins import catalog
from acwm_planning.controllers import Controller, Decision, PlanningController
from acwm_planning.futures import History


class TaskVariant(Task):
    """A task with other goals or another time limit.

    With `steps`, the goal is the state that the behaviour policy reaches from the start after this
    many frames, as in stable-worldmodel. The task still decides whether it is reached.

    Args:
        task: defines distance, tolerance and failures.
        steps: frames of behaviour between the start and the goal; None for the task's own goals.
        max_steps: maximum number of actions in an episode; the task's own by default.
    """

    def __init__(self, task: Task, *, steps: int | None, max_steps: int | None) -> None:
        self._task, self._steps = task, steps
        self.name, self.summary, self.unit = task.name, task.summary, task.unit
        self.tolerance, self.avoid = task.tolerance, task.avoid
        self.max_steps = max_steps or task.max_steps

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        if self._steps is None:
            return self._task.sample_goal(environment, rng)
        act = environment.policy(rng)
        for _ in range(self._steps):
            environment.advance(act())
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        return self._task.distance(seen, goal)

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        return self._task.failed(seen, goal)

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        return self._task.success(seen, goal)

    def solution(
        self, environment: Environment, goal: Goal, rng: np.random.Generator
    ) -> Policy | None:
        """None with `steps`: the script may only know the task's own goals."""
        return self._task.solution(environment, goal, rng) if self._steps is None else None


def load_task(environment: str, name: str) -> Task:
    """A task of an environment, by their names."""
    return catalog().component("environment", environment).load_task(name)


def spec_of_seed(card: EnvironmentCard, seed: int) -> EpisodeSpec:
    """The episode of a seed: its number in the test split, on which no model was trained."""
    return EpisodeSpec(card.name, "ind_test", seed, options={"size": card.frame_size})


@dataclass(frozen=True)
class EpisodeStart:
    """The start of an episode.

    Attributes:
        history: the context frames for a model; nothing moves in them.
        goal: goal of the episode.
        distance: distance from it.
    """

    history: History
    goal: Goal
    distance: float

    @property
    def frames(self) -> NDArray[np.uint8]:
        """The context frames `[K, H, W, 3]`."""
        return np.stack(self.history.frames)


def start_of(
    environment: TaskEnvironment, spec: EpisodeSpec, *, given: int = 1, goal: Goal | None = None
) -> EpisodeStart:
    """Start an episode, with its own goal or with a given one.

    Args:
        environment: the environment with its task.
        spec: spec of the episode.
        given: number of context frames for a model.
        goal: the goal; by default the task draws one.
    """
    options = {"spec": spec, **({} if goal is None else {"goal": goal})}
    frame, info = environment.reset(options=options)
    history = History(spec, [frame])
    for _ in range(given - 1):
        history.actions.append(environment.environment.still_action())
        frame, _, _, _, info = environment.step(history.actions[-1])
        history.frames.append(frame)
    return EpisodeStart(history, environment.goal, float(info["distance"]))


@dataclass(frozen=True)
class EpisodeResult:
    """An episode that was played, with its result."""

    history: History
    goal: Goal
    distances: list[float]  # distance from the goal at the start, and after every action
    successes: list[bool]  # whether the task is solved after every action
    failed: bool
    decisions: list[Decision]  # of a planner; empty for other controllers

    @property
    def success(self) -> bool:
        """Whether the task is solved in the end."""
        return self.successes[-1]

    @property
    def actions(self) -> NDArray[np.float32]:
        """The controller's actions `[T, A]`, without those between context frames."""
        return np.stack(self.history.actions[-len(self.successes) :])

    @property
    def frames(self) -> NDArray[np.uint8]:
        """The frame after each of them, `[T, H, W, 3]`."""
        return np.stack(self.history.frames[-len(self.successes) :])

    def facts(self) -> dict[str, Any]:
        """A summary that can be written as JSON."""
        facts: dict[str, Any] = {
            "success": self.success,
            "failed": self.failed,
            "steps": len(self.successes),
            "start_distance": self.distances[0],
            "distance": self.distances[-1],
            "decisions": len(self.decisions),
        }
        if self.decisions:
            seconds = [decision.seconds for decision in self.decisions]
            evaluations = [decision.plan.evaluations for decision in self.decisions]
            facts["seconds_per_decision"] = float(np.mean(seconds))
            facts["rollouts_per_decision"] = float(np.mean(evaluations))
        return facts


def play(
    environment: TaskEnvironment,
    spec: EpisodeSpec,
    controller: Controller,
    *,
    steps: int | None = None,
    given: int = 1,
    goal: Goal | None = None,
) -> EpisodeResult:
    """Play an episode.

    Args:
        environment: the environment with its task.
        spec: spec of the episode.
        controller: chooses the actions.
        steps: number of actions; by default until the task is solved or its time is over.
        given: see `start_of`.
        goal: see `start_of`.
    """
    parts = environment.environment, environment.task, controller
    with noting(f"in episode {spec.index} of {spec.split}", *parts):
        start = start_of(environment, spec, given=given, goal=goal)
        history, distances, successes = start.history, [start.distance], list[bool]()
        controller.begin(environment.environment, environment.task, environment.goal)
        over, info = False, dict[str, Any]()
        while not over:
            for action in controller.act(history):
                frame, _, solved, late, info = environment.step(action)
                history.frames.append(frame)
                history.actions.append(action)
                distances.append(info["distance"])
                successes.append(info["success"])
                if over := solved or late if steps is None else len(successes) >= steps:
                    break
    decisions = controller.decisions if isinstance(controller, PlanningController) else []
    return EpisodeResult(
        history, environment.goal, distances, successes, bool(info["failed"]), decisions
    )
