"""Plans to a goal that is a picture: nothing is simulated, so recordings are enough."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import magnification, to_pixels
from acwm_core.data.video import write_mp4
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import Observation
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.evaluate import check_environment, choose_device
from acwm_core.evaluation.videos import join_panels
from acwm_core.files import writing, written_whole
from acwm_core.training.run import RunBundle
from acwm_planning.controllers import PlanningController
from acwm_planning.episode import spec_of_seed
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.run import make_cost, make_planner
from acwm_planning.settings import Settings

ACTIONS, VIDEO = "actions.csv", "imagined.mp4"


NO_TASK = "this cost needs a task, and a goal picture has none: take cost=points or cost=latent"


class PictureTask(Task):
    """What a goal is that only a picture shows: no state is known, and nothing judges success."""

    name, summary, unit = "picture", "reach what a picture shows", ""
    tolerance, max_steps = 0.0, 1

    def sample_goal(self, environment: Any, rng: np.random.Generator) -> Goal:
        """Nothing draws a goal."""
        raise RecipeError(NO_TASK)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Nothing is known."""
        raise RecipeError(NO_TASK)


@dataclass(frozen=True)
class PicturePlan:
    """A plan from where an episode is to what a picture shows.

    Attributes:
        actions: raw actions `[T, A]`.
        cost: of the plan.
        still_cost: of the actions nearest to zero, or of holding the last one if actions are
            positions.
        imagined: what the model predicts of them, `[T, H, W, 3]` uint8.
        goal: the goal picture `[H, W, 3]`.
    """

    actions: NDArray[np.float32]
    cost: float
    still_cost: float
    imagined: NDArray[np.uint8]
    goal: Frame


class PicturePlanner:
    """Plans to goal pictures with the model of a run.

    Args:
        bundle: the loaded run.
        settings: of planning.
        device: of the model; ``"auto"`` takes a GPU if there is one.
        action_std: see `PlanningController`.

    Raises:
        RecipeError: the cost is of states.
    """

    def __init__(
        self,
        bundle: RunBundle,
        settings: Settings,
        device: str = "auto",
        action_std: Sequence[float] | None = None,
    ) -> None:
        self.card: EnvironmentCard = bundle.card
        self._cost = make_cost(settings, self.card)
        if self._cost.judged:
            raise RecipeError(NO_TASK)
        world = bundle.world_model.to(choose_device(device))
        self._rollouts = ModelRollouts(world, self.card, None, **settings.rollouts(self._cost))
        self._controller = PlanningController(
            make_planner(settings), self._rollouts, self._cost, action_std=action_std
        )

    def plan(
        self,
        frames: Sequence[Frame],
        actions: Sequence[NDArray[np.float32]],
        goal: Frame,
        seed: int = 0,
    ) -> PicturePlan:
        """The best plan from the last frame on.

        Args:
            frames: all frames so far, `[H, W, 3]` uint8 each, at least one.
            actions: the raw actions between them, `[A]` each.
            goal: what is to be seen.
            seed: of the search.

        Raises:
            RecipeError: frames and goal do not have the size of the model's, or the cost needs a
                task.
        """
        shape = (*self.card.frame_size, 3)
        for picture in (*frames, goal):
            if picture.shape != shape or picture.dtype != np.uint8:
                raise RecipeError(
                    f"pictures are uint8 {list(shape)}, not {picture.dtype} {list(picture.shape)}"
                )
        history = History(spec_of_seed(self.card, seed), [*frames], [*actions])
        aim = Goal({}, np.zeros(shape[:2], np.uint8), goal)
        controller, still = self._controller, self._still(actions)
        controller.aim(PictureTask(), aim, self.card.action, still, seed)
        controller.act(history)
        (decision,) = controller.decisions
        planned = decision.plan.actions.detach().cpu()
        judge = self._rollouts.cost(
            history, still, GoalCost(self._cost, PictureTask(), aim), decision.seed
        )
        with torch.no_grad():
            rest = judge(torch.from_numpy(still).expand_as(planned)[None])
        imagined = to_pixels(self._rollouts.imagine(history, still, planned, decision.seed))
        return PicturePlan(planned.numpy(), decision.plan.cost, float(rest[0]), imagined, goal)

    def _still(self, actions: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        spec = self.card.action
        if spec.kind == "absolute" and len(actions):
            return np.asarray(actions[-1], np.float32)
        none = np.zeros(spec.size, np.float32)
        return np.clip(none, spec.low, spec.high, dtype=np.float32)


def begin_of(
    bundle: RunBundle, data: str | Path, episode: int, goal: bool, ahead: int
) -> tuple[list[Frame], list[NDArray[np.float32]], Frame]:
    """The beginning of a test episode: its given frames, the actions between them, and a goal.

    Args:
        bundle: the loaded run.
        data: the data folder.
        episode: number of the episode in ``ind_test``.
        goal: whether a goal is needed; else it is the last given frame.
        ahead: how many frames after the given ones the goal is, or the last frame if that is
            earlier.

    Raises:
        DataError: there is no such episode, or it is too short.
    """
    episodes = EpisodeDataset(data, "ind_test")
    check_environment(episodes, bundle.card)
    if not 0 <= episode < len(episodes):
        raise DataError(f"{data} has no test episode {episode}: give 0 to {len(episodes) - 1}")
    recorded, given = episodes[episode], bundle.world_model.context_frames
    if len(recorded.video) <= given:
        raise DataError(f"episode {episode} is too short: it has {len(recorded.video)} frames")
    last = min(given - 1 + ahead, len(recorded.video) - 1) if goal else given - 1
    video = cast(NDArray[np.uint8], recorded.video)
    return [*video[:given]], [*recorded.actions[: given - 1]], video[last]


def write_plan(out: Path, plan: PicturePlan, card: EnvironmentCard) -> None:
    """Write the actions as a table, and what the model imagines of them beside the goal."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with written_whole(out / ACTIONS) as partial, partial.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(card.action.names)
            rows.writerows([f"{number:.6g}" for number in row] for row in plan.actions.tolist())
        goal = np.broadcast_to(plan.goal, plan.imagined.shape)
        frames = join_panels([plan.imagined, goal])
        write_mp4(out / VIDEO, frames, card.fps, magnification(card.frame_size[0]))
