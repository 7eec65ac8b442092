"""`RewardTask`: a reward in place of a task, for what asks a task how good a state is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import EnvironmentCard
from acwm_core.env.environment import Environment
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task
from acwm_core.errors import RecipeError
from acwm_planning.rewards.head import RewardHead, digest_of


class RewardTask(Task):
    """To reach the highest reward that was recorded, as a head on states predicts it.

    The distance is what the predicted reward lacks of it, so a learner that is rewarded for coming
    nearer maximises, of discounted rewards, their sum. It has no goal.

    Args:
        head: predicts the reward.
        max_steps: number of actions of an episode.

    Raises:
        RecipeError: the head looks at latents.
    """

    name, summary, unit = "reward", "the highest reward that was recorded", ""
    folder: Path | None = None

    def __init__(self, head: RewardHead, max_steps: int) -> None:
        if not head.card.state:
            raise RecipeError(
                "this reward is of latents, and only one of states can judge a scene: train one "
                "without --latents, on data with states"
            )
        self.head, self.tolerance, self.max_steps = head, head.card.tolerance, max_steps

    @classmethod
    def read(cls, folder: str | Path, card: EnvironmentCard) -> RewardTask:
        """The task of a head's folder; an episode is as long as those of the environment.

        Raises:
            DataError: there is no head.
            RecipeError: it looks at latents, or is of another environment.
        """
        head = RewardHead.read(folder)
        head.check(card)
        task = cls(head, card.horizon - 1)
        task.folder = Path(folder)
        return task

    def facts(self) -> dict[str, str]:
        """Where the head is, what its file holds, and its error."""
        assert self.folder is not None
        return {
            "head": str(self.folder),
            "sha256": digest_of(self.folder),
            "held_out": self.head.card.held_out.text,
        }

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The current moment: the reward asks for no goal."""
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """By how much the predicted reward is below the highest recorded one, `[T]`.

        Raises:
            RecipeError: a field that the head looks at is not known.
        """
        card = self.head.card
        fields = {field.name: seen.states.get(field.name) for field in card.state}
        if missing := [name for name, values in fields.items() if values is None]:
            raise RecipeError(
                f"the reward {card.column} looks at {', '.join(missing)}, which is not known here: "
                "train one of other --states"
            )
        return np.maximum(card.best - self.head.of_states(fields).numpy(), 0)
