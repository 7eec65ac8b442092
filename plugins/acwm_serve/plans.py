"""Plans for clients: the next actions towards a goal, from the frames that a robot has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import StateEstimator
from acwm_core.env.task import Goal, Task
from acwm_core.model.world_model import WorldModel
from acwm_planning.controllers import PlanningController
from acwm_planning.futures import History, ModelRollouts
from acwm_planning.run import make_cost, make_planner
from acwm_planning.settings import settings_of


@dataclass(frozen=True)
class PlanRequest:
    """A client's question for actions.

    Attributes:
        planner: that of its session.
        frames: the last frames that it has seen, `[N, H, W, 3]` uint8.
        actions: the raw actions between them, `[N − 1, A]`.
        goal: picture of the goal, `[H, W, 3]` uint8.
        still: raw action that means no motion, `[A]`.
        seed: of a new goal's search.
    """

    planner: GoalPlanner
    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]
    goal: NDArray[np.uint8]
    still: NDArray[np.float32]
    seed: int


class GoalPlanner:
    """Plans for one client with the settings of a task; a search goes on from the last plan.

    Args:
        world_model: predicts what actions do.
        card: card of its environment.
        task: the task; its distance to the goal is what a plan reduces.
        estimator: reads states in pictures.
        action_std: standard deviation `[A]` of the raw actions that the model was trained on, if
            known.
    """

    def __init__(
        self,
        world_model: WorldModel,
        card: EnvironmentCard,
        task: Task,
        estimator: StateEstimator,
        action_std: Sequence[float] | None,
    ) -> None:
        settings = settings_of([], declared=task.planning)
        self._card, self._task = card, task
        cost = make_cost(settings, card)
        reading = estimator if cost.observes else None
        self._controller = PlanningController(
            make_planner(settings),
            ModelRollouts(world_model, card, reading, **settings.rollouts(cost)),
            cost,
            action_std=action_std,
        )
        self._aim: bytes | None = None

    def plan(self, request: PlanRequest, goal: Goal) -> NDArray[np.float32]:
        """The next raw actions `[N, A]`."""
        picture = request.goal.tobytes()
        if picture != self._aim:
            self._controller.aim(self._task, goal, self._card.action, request.still, request.seed)
            self._aim = picture
        history = History(EpisodeSpec(self._card.name), [*request.frames], [*request.actions])
        return np.stack(self._controller.act(history))
