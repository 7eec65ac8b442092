"""`cost=reward`: what the reward of predicted futures lacks of the highest that was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from torch import Tensor

from acwm_core.env.card import EnvironmentCard
from acwm_core.env.task import Goal, Task
from acwm_core.errors import RecipeError
from acwm_planning.costs import StateDistance, last_frames
from acwm_planning.planner import Futures
from acwm_planning.rewards.head import RewardHead, digest_of
from acwm_planning.rewards.task import RewardTask


class RewardCost(StateDistance):
    """What the reward lacks of the highest that was recorded, by a head of `acwm train-reward`.

    A head on states looks at those that the model predicts, or that an estimator reads in its
    frames, as `cost=state` does; a head on latents at the predicted ones. The mean over frames.

    Args:
        head: the head's folder.
        frames: number of latent frames to judge, evenly spaced and including the last; null for
            all.
        read: "model" or "pictures", the only source of states; null for the model's own where they
            are enough.
        unknown: penalty in standard deviations of the reward, times the share of frames in which
            it is unknown.

    Raises:
        DataError: there is no head.
    """

    judged = False

    def __init__(
        self,
        *,
        head: str,
        frames: int | None = 3,
        read: Literal["model", "pictures"] | None = None,
        unknown: float = 10.0,
    ) -> None:
        super().__init__(frames=frames, read=read, failure=0.0, unknown=unknown)
        self.head, self._digest, self._task = RewardHead.read(head), digest_of(head), None
        if self.head.card.state:
            self._task = RewardTask(self.head, 1)
            self._task.tolerance = self.head.card.std  # the unit of the cost

    def check(self, card: EnvironmentCard) -> None:
        """Refuse another environment than the head's."""
        self.head.check(card)

    def about(self) -> Mapping[str, str]:
        """The head's file and its error."""
        return {"head": self._digest[:12], "head_error": self.head.card.held_out.text}

    def __call__(self, futures: Futures, task: Task, goal: Goal) -> Tensor:
        """See `Cost`. The unit is a standard deviation of the reward."""
        if self._task is not None:
            return super().__call__(futures, self._task, goal)
        card = self.head.card
        if futures.encoding not in ("", card.latents):
            raise RecipeError(
                "the reward is of latents of another codec: train one with --run and this model"
            )
        latents = futures.latents(last_frames(futures.length, self.frames))
        rewards = self.head.of_latents(latents.flatten(0, 1)).unflatten(0, latents.shape[:2])
        return ((card.best - rewards).clamp(min=0) / card.std).mean(1).float()
