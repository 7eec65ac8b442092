"""Controllers that choose the actions of an episode: a planner with a model, and baselines."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, Environment, Policy
from acwm_core.env.task import Goal, Task
from acwm_core.errors import PluginError, RecipeError, check_shape
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.planner import Cost, Plan, Planner, RolloutCost
from acwm_planning.prior import PolicyPrior
from acwm_planning.scripts import check_bounds, script
from acwm_planning.search import SearchPlanner

Actions = Sequence[NDArray[np.float32]]
"""The next raw actions, `[A]` each; at least one."""


class Controller(ABC):
    """Chooses the next actions, and is asked again when they are done."""

    @abstractmethod
    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        """Start an episode. `environment` is at its start; the controller may look at it.

        Raises:
            RecipeError: the controller cannot act in this episode.
        """

    @abstractmethod
    def act(self, history: History) -> Actions:
        """The next actions."""


class StillController(Controller):
    """Always takes the action that means no motion."""

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        self._environment = environment

    def act(self, history: History) -> Actions:
        """The action that currently means no motion."""
        return [self._environment.still_action()]


class RandomController(Controller):
    """Uniform random actions within the bounds, each held for one action block of the planner."""

    def __init__(self, action_block: int) -> None:
        self._block = action_block

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        self._space = environment.action_space
        self._rng = environment.episode_spec.rng("random actions")

    def act(self, history: History) -> Actions:
        """One block of a random action."""
        low, high = self._space.low, self._space.high  # pyright: ignore[reportAttributeAccessIssue]
        action = self._rng.uniform(low, high).astype(np.float32)
        return [np.clip(action, low, high)] * self._block


class PolicyController(Controller):
    """Asks a policy that looks at the simulator before each action.

    Args:
        create: creates the policy of an episode.
    """

    def __init__(self, create: Callable[[Environment, Task, Goal], Policy]) -> None:
        self._create = create

    @classmethod
    def scripted(cls, *, solves: bool) -> PolicyController:
        """Follows the behaviour policy, which does not know the goal, or the task's solution."""
        return cls(partial(script, solves=solves))

    @classmethod
    def replaying(cls, actions: Iterable[NDArray[np.float32]]) -> PolicyController:
        """Takes these raw actions, `[A]` each."""
        return cls(lambda environment, task, goal: iter(actions).__next__)

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        self._policy = self._create(environment, task, goal)

    def act(self, history: History) -> Actions:
        """One action."""
        return [np.asarray(self._policy(), np.float32)]


class Rollouts(Protocol):
    """Predicts the futures of candidates: `ModelRollouts` or `SimulatorRollouts`."""

    def cost(
        self, history: History, still: NDArray[np.float32], goal_cost: GoalCost, seed: int
    ) -> RolloutCost:
        """A function that maps candidates, which continue `history`, to their costs."""
        ...


@dataclass(frozen=True)
class Decision:
    """One call of a planner."""

    frame: int  # frame of the episode at which it was called, from 0
    plan: Plan
    seconds: float
    seed: int  # seed of the model's noise


class PlanningController(Controller):
    """Model-predictive control: plan, execute the first actions of the plan, and plan again.

    Args:
        planner: the planner.
        rollouts: predicts the futures of its candidates.
        cost: cost of the futures.
        seed: added to the episode's seed, for the planner's randomness and the model's noise.
        action_std: standard deviation `[A]` of the raw actions that the model was trained on, if
            known.

    Attributes:
        decisions: decisions of the current episode.
        still: the action that means no motion at the start of the episode.
    """

    still: NDArray[np.float32]

    def __init__(
        self,
        planner: Planner,
        rollouts: Rollouts,
        cost: Cost,
        seed: int = 0,
        action_std: Sequence[float] | None = None,
    ) -> None:
        self.rollouts, self._planner, self._cost, self._seed = rollouts, planner, cost, seed
        self._action_std = (
            None if action_std is None else torch.tensor(action_std, dtype=torch.float32)
        )
        self.decisions: list[Decision] = []
        self._prior = _prior_of(planner, rollouts)

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        rng = environment.episode_spec.rng("planner")
        still, seed = environment.still_action(), int(rng.integers(2**31))
        self.aim(task, goal, environment.card.action, still, seed)

    def aim(
        self, task: Task, goal: Goal, action: ActionSpec, still: NDArray[np.float32], seed: int
    ) -> None:
        """Start towards a goal, in a simulator that is not at hand.

        Args:
            task: the task to solve.
            goal: its goal.
            action: spec of the simulator's actions.
            still: the action `[A]` that means no motion now.
            seed: of this episode.
        """
        self._planner.reset()
        if self._prior is not None:
            self._prior.begin(task, goal)
        self.decisions, self.still = [], still
        self._goal_cost = GoalCost(self._cost, task, goal)
        self._low, self._high = torch.tensor(action.low), torch.tensor(action.high)
        self._absolute = action.kind == "absolute"
        self._base = seed + self._seed
        self._generator = torch.Generator().manual_seed(self._base)

    def act(self, history: History) -> Actions:
        """The first actions of a new plan."""
        start = time.perf_counter()
        seed = self._base + len(self.decisions)
        self._set_region(history)
        cost = self.rollouts.cost(history, self.still, self._goal_cost, seed)
        plan = self._planner.plan(cost, self._low, self._high, self._generator)
        seconds, count = time.perf_counter() - start, self._planner.actions_per_plan
        first = self._valid_actions(plan)[: max(0, count)]
        if not len(first):
            owner = type(self._planner).__name__
            raise PluginError(f"{owner} plans no actions, or actions_per_plan = {count} takes none")
        self.decisions.append(Decision(len(history.actions), plan, seconds, seed))
        return [*first]

    def _set_region(self, history: History) -> None:
        """Set the region that a planner of this package searches.

        The search starts from the action that means no motion. The environment gives that action
        for the start. If actions are absolute positions, it changes during the episode: then it is
        the last action taken.
        """
        if not isinstance(self._planner, SearchPlanner):
            return
        moved = self._absolute and history.actions
        still = torch.from_numpy(np.asarray(history.actions[-1] if moved else self.still))
        half = (self._high - self._low) / 2
        action_std = None if self._action_std is None else self._action_std / half
        self._planner.search_near((still - self._low) / half - 1, action_std)
        if self._prior is not None:
            length = self._planner.horizon * self._planner.action_block
            actions = self._prior.actions(history, self.still, length)
            self._planner.propose((actions - self._low) / half - 1)

    def _valid_actions(self, plan: Plan) -> NDArray[np.float32]:
        """The actions `[T, A]` of a valid plan.

        Raises:
            PluginError: the actions have another size, or are not valid for the environment.
        """
        actions = torch.as_tensor(plan.actions).detach().cpu().numpy().astype(np.float32)
        check_shape(self._planner, "plan", actions, -1, len(self._low))
        check_bounds(self._planner, "plan", actions, self._low.numpy(), self._high.numpy())
        return actions


def _prior_of(planner: Planner, rollouts: Rollouts) -> PolicyPrior | None:
    """The policy whose actions the search starts from, if the planner names one.

    Raises:
        RecipeError: nothing predicts the states that the policy acts on.
    """
    if not isinstance(planner, SearchPlanner) or planner.prior is None:
        return None
    if not isinstance(rollouts, ModelRollouts):
        raise RecipeError(
            "planner.prior acts on the states that a model predicts, so the rows simulator and "
            "codec, and acwm play, cannot use it: leave it out there"
        )
    return PolicyPrior(planner.prior, rollouts)
