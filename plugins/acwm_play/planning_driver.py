"""Lets a planner act in a simulator of which it sees pictures only."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.evaluation.score import estimator_for
from acwm_core.model.shapes import Actions
from acwm_core.model.world_model import WorldModel
from acwm_planning.controllers import PlanningController, Rollouts
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.planner import RolloutCost
from acwm_planning.run import make_cost, make_planner
from acwm_planning.settings import settings_of
from acwm_play.driver import Driver


class PlanningDriver(Driver):
    """Model-predictive control with the settings that the task declares (`Task.planning`).

    Goals are the task's own, whatever it declares of them, and its actions are not limited.

    Args:
        world_model: the world model, in evaluation mode.
        card: card of the simulator.
        task: the task to solve.
        action_std: standard deviation `[A]` of the raw actions that the model was trained on, if
            known.
        steps: sampling steps; those of the task's settings, or the model's own, by default.
    """

    def __init__(
        self,
        *,
        world_model: WorldModel,
        card: EnvironmentCard,
        task: Task,
        action_std: Sequence[float] | None = None,
        steps: int | None = None,
    ) -> None:
        overrides = [] if steps is None else [f"steps={steps}"]
        settings = settings_of(overrides, declared=task.planning)
        planner, cost = make_planner(settings), make_cost(settings, card)
        estimator = estimator_for(card) if cost.observes else None
        rollouts = ModelRollouts(world_model, card, estimator, **settings.rollouts(cost))
        self._card, self._task, self._rollouts = card, task, _InterruptibleRollouts(rollouts)
        self._controller = PlanningController(planner, self._rollouts, cost, action_std=action_std)

    def begin(self, goal: Goal, still: NDArray[np.float32], seed: int) -> None:
        self._controller.aim(self._task, goal, self._card.action, still, seed)

    def act(
        self,
        frames: Sequence[Frame],
        actions: Sequence[NDArray[np.float32]],
        check: Callable[[], None],
    ) -> Sequence[NDArray[np.float32]]:
        """See `Driver.act`: the first actions of a new plan."""
        self._rollouts.check = check
        spec = EpisodeSpec(self._card.name)
        return self._controller.act(History(spec, list(frames), list(actions)))


class _InterruptibleRollouts:
    """Rollouts that call `check` before candidates are rolled out."""

    check: Callable[[], None]

    def __init__(self, rollouts: Rollouts) -> None:
        self._rollouts = rollouts

    def cost(
        self, history: History, still: NDArray[np.float32], goal_cost: GoalCost, seed: int
    ) -> RolloutCost:
        cost = self._rollouts.cost(history, still, goal_cost, seed)

        def interruptible(actions: Actions) -> Tensor:
            self.check()
            return cost(actions)

        return interruptible
