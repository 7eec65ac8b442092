"""Scripts that act in the simulator: a task's own solution, and the policy of the data."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.task import Goal, Task
from acwm_core.errors import PluginError, RecipeError, check_shape


class NoSolutionError(RecipeError):
    """A task has no scripted solution."""


def script(
    environment: Environment, task: Task, goal: Goal, *, solves: bool, bounded: bool = True
) -> Policy:
    """The script of an episode, which looks at the simulator before each action.

    Args:
        environment: the environment, at the start of the episode.
        task: the task.
        goal: its goal.
        solves: use the task's solution instead of the behaviour policy, which knows no goal.
        bounded: refuse actions that are out of bounds, not only those that are not finite.

    Raises:
        NoSolutionError: the task has no scripted solution.
        PluginError: from the script, if an action is not valid for the environment.
    """
    rng, action_spec = environment.episode_spec.rng("policy"), environment.card.action
    owner, method = (task, "solution") if solves else (environment, "policy")
    policy = task.solution(environment, goal, rng) if solves else environment.policy(rng)
    if policy is None:
        raise NoSolutionError(f"the task {task.name!r} has no scripted solution")
    low, high = np.array(action_spec.low), np.array(action_spec.high)

    def act() -> NDArray[Any]:
        action = np.asarray(policy())
        check_shape(owner, method, action, len(low))
        if bounded:
            check_bounds(owner, method, action, low, high)
        elif not np.isfinite(action).all():
            raise PluginError(
                f"{type(owner).__name__}.{method} returns numbers that are not finite"
            )
        return action

    return act


def check_bounds(
    component: object,
    method: str,
    actions: NDArray[Any],
    low: NDArray[Any],
    high: NDArray[Any],
) -> None:
    """Refuse actions `[…, A]` that are not valid for the environment.

    Raises:
        PluginError: an action is not finite, or out of bounds by more than rounding.
    """
    slack = 1e-6 * (high - low)
    wrong = ~((actions >= low - slack) & (actions <= high + slack))
    if wrong.any():
        value = actions[wrong][0]
        bounds = f"from {[*map(float, low)]} to {[*map(float, high)]}"
        raise PluginError(
            f"{type(component).__name__}.{method} gives {value:g}, not actions {bounds}"
        )
