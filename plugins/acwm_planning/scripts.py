"""Scripts that act in the simulator: a task's own solution, and the policy of the data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.task import Goal, Task
from acwm_core.errors import RecipeError, check_shape


class NoSolutionError(RecipeError):
    """A task has no scripted solution."""


@dataclass(frozen=True)
class Script:
    """A script in an episode, which looks at the simulator before each action.

    Attributes:
        owner: the task or the environment, of which it is a method.
        method: the method's name.
        policy: the script.
        size: length A of an action.
    """

    owner: Task | Environment
    method: str
    policy: Policy
    size: int

    @classmethod
    def begin(cls, environment: Environment, task: Task, goal: Goal, *, solves: bool) -> Script:
        """Start the solution of a task or, unless it `solves`, the behaviour policy.

        Raises:
            NoSolutionError: the task has no scripted solution.
        """
        rng, size = environment.episode_spec.rng("policy"), environment.card.action.size
        if not solves:
            return cls(environment, "policy", environment.policy(rng), size)
        if (policy := task.solution(environment, goal, rng)) is None:
            raise NoSolutionError(f"the task {task.name!r} has no scripted solution")
        return cls(task, "solution", policy, size)

    def act(self) -> NDArray[Any]:
        """The next raw action `[A]`, which may be out of bounds."""
        action = np.asarray(self.policy())
        check_shape(self.owner, self.method, action, self.size)
        return action
