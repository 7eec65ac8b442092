"""Who acts in an episode: a planner with a model, or what it is compared with."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.environment import Environment, Policy
from acwm_core.errors import RecipeError
from acwm_core.planning.planner import Cost, Plan, Planner, RolloutCost
from acwm_core.planning.task import Goal, Task
from acwm_planning.futures import History

Actions = Sequence[NDArray[np.float32]]
"""The next raw actions, `[A]` each, at least one."""


class NoSolutionError(RecipeError):
    """A task has no scripted solution."""


class Controller(ABC):
    """Says what is done next, until it is asked again."""

    @abstractmethod
    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """An episode starts; `environment` is at its start, and may be looked at.

        Raises:
            RecipeError: it cannot act in this episode.
        """

    @abstractmethod
    def act(self, history: History) -> Actions:
        """The next actions."""


class Still(Controller):
    """Asks for no motion."""

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """See `Controller`."""
        self._environment = environment

    def act(self, history: History) -> Actions:
        """What means no motion now."""
        return [self._environment.still_action()]


class RandomActions(Controller):
    """Actions evenly within their bounds, each for as long as a planner's block."""

    def __init__(self, action_block: int) -> None:
        self._block = action_block

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """See `Controller`."""
        self._space = environment.action_space
        self._rng = environment.episode_spec.rng("random actions")

    def act(self, history: History) -> Actions:
        """A block."""
        low, high = self._space.low, self._space.high  # pyright: ignore[reportAttributeAccessIssue]
        action = self._rng.uniform(low, high).astype(np.float32)
        return [np.clip(action, low, high)] * self._block


class Scripted(Controller):
    """The behaviour policy, which knows no goal, or the task's own solution.

    Args:
        solves: the solution.
    """

    def __init__(self, *, solves: bool) -> None:
        self._solves = solves
        self._policy: Policy | None = None

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """See `Controller`."""
        rng = environment.episode_spec.rng("policy")
        if self._solves:
            self._policy = task.solution(environment, goal, rng)
        else:
            self._policy = environment.policy(rng)
        if self._policy is None:
            raise NoSolutionError(f"the task {task.name!r} has no scripted solution")

    def act(self, history: History) -> Actions:
        """One action, as it looks at the simulator each time."""
        assert self._policy is not None
        return [np.asarray(self._policy(), np.float32)]


class Rollouts(Protocol):
    """Where candidates lead: `ModelRollouts` or `SimulatorRollouts`."""

    def cost(
        self,
        history: History,
        still: NDArray[np.float32],
        judge: Cost,
        task: Task,
        goal: Goal,
        seed: int,
    ) -> RolloutCost:
        """What candidates cost that follow what has happened."""
        ...


@dataclass(frozen=True)
class Decision:
    """One time at which a planner was asked."""

    frame: int  # of the episode, 0 for its first
    plan: Plan
    seconds: float
    seed: int  # of the noise


class Planned(Controller):
    """Model-predictive control: plans, takes the first actions of the plan, and plans again.

    Args:
        planner: which.
        rollouts: where its candidates lead.
        judge: what they cost.
        seed: of the planner's randomness and of the model's noise, with that of the episode.

    Attributes:
        decisions: of the running episode.
        still: the action of the episode's start that asks for no motion.
    """

    still: NDArray[np.float32]

    def __init__(self, planner: Planner, rollouts: Rollouts, judge: Cost, seed: int = 0) -> None:
        self.rollouts, self._planner, self._judge, self._seed = rollouts, planner, judge, seed
        self.decisions: list[Decision] = []

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """See `Controller`."""
        self._planner.reset()
        self.decisions, self.still = [], environment.still_action()
        self._task, self._goal = task, goal
        action = environment.card.action
        self._low, self._high = torch.tensor(action.low), torch.tensor(action.high)
        rng = environment.episode_spec.rng("planner")
        self._base = int(rng.integers(2**31)) + self._seed
        self._generator = torch.Generator().manual_seed(self._base)

    def act(self, history: History) -> Actions:
        """The first actions of a new plan."""
        began = time.perf_counter()
        seed = self._base + len(self.decisions)
        cost = self.rollouts.cost(history, self.still, self._judge, self._task, self._goal, seed)
        plan = self._planner.plan(cost, self._low, self._high, self._generator)
        seconds = time.perf_counter() - began
        self.decisions.append(Decision(len(history.actions), plan, seconds, seed))
        return [*plan.actions[: self._planner.actions_per_plan].numpy()]
