"""One episode of a task, played in the true simulator by a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from acwm_core.env.environment import Environment, EnvironmentCard, Policy
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import noting
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

    def distance(self, seen: Observation, goal: Goal) -> np.ndarray[Any, np.dtype[np.float64]]:
        return self._task.distance(seen, goal)

    def failed(self, seen: Observation, goal: Goal) -> np.ndarray[Any, np.dtype[np.bool_]]:
        return self._task.failed(seen, goal)

    def success(self, seen: Observation, goal: Goal) -> np.ndarray[Any, np.dtype[np.bool_]]:
        return self._task.success(seen, goal)

    def solution(
        self, environment: Environment, goal: Goal, rng: np.random.Generator
    ) -> Policy | None:
        """None with `steps`: the script may only know the task's own goals."""
        return self._task.solution(environment, goal, rng) if self._steps is None else None


def spec_of_seed(card: EnvironmentCard, seed: int) -> EpisodeSpec:
    """The episode of a seed: its number in the test split, on which no model was trained."""
    return EpisodeSpec(card.name, "ind_test", seed, options={"size": card.frame_size})


@dataclass(frozen=True)
class EpisodeResult:
    """An episode that was played, with its result."""

    history: History
    goal: Goal
    distances: list[float]  # distance from the goal in every frame
    success: bool
    failed: bool
    decisions: list[Decision]  # of a planner; empty for other controllers

    def facts(self) -> dict[str, Any]:
        """A summary that can be written as JSON."""
        facts: dict[str, Any] = {
            "success": self.success,
            "failed": self.failed,
            "steps": len(self.history.actions),
            "start_distance": self.distances[0],
            "distance": self.distances[-1],
            "decisions": len(self.decisions),
        }
        if self.decisions:
            facts["seconds_per_decision"] = float(
                np.mean([each.seconds for each in self.decisions])
            )
            evaluations = [each.plan.evaluations for each in self.decisions]
            facts["rollouts_per_decision"] = float(np.mean(evaluations))
        return facts


def play(environment: TaskEnvironment, spec: EpisodeSpec, controller: Controller) -> EpisodeResult:
    """Play an episode until its task is solved or its time is over."""
    parts = environment.environment, environment.task, controller
    with noting(f"in episode {spec.index} of {spec.split}", *parts):
        frame, info = environment.reset(options={"spec": spec})
        history, distances = History(spec, [frame]), [info["distance"]]
        controller.begin(environment.environment, environment.task, environment.goal)
        over = False
        while not over:
            for action in controller.act(history):
                frame, _, solved, late, info = environment.step(action)
                history.frames.append(frame)
                history.actions.append(action)
                distances.append(info["distance"])
                if over := solved or late:
                    break
    decisions = controller.decisions if isinstance(controller, PlanningController) else []
    solved, failed = bool(info["success"]), bool(info["failed"])
    return EpisodeResult(history, environment.goal, distances, solved, failed, decisions)
