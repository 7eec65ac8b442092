"""Lets a policy that `acwm policy train` has trained act in a simulator, from pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.score import estimator_for
from acwm_planning.policies.saved import default_folder, is_policy, policy_for
from acwm_play.driver import Driver


class PolicyDriver(Driver):
    """The policy in the folder that `acwm policy train` chooses for the task.

    The estimator of the world reads the states that the policy observes from the last frame.

    Args:
        card: card of the simulator.
        task: the task to solve.
        others: what other drivers need.

    Raises:
        RecipeError: no policy was trained for the task.
        DataError: no estimator reads states of this world.
    """

    def __init__(self, *, card: EnvironmentCard, task: Task, **others: Any) -> None:
        name = f"{card.name}.{task.name}"
        folder = default_folder(name)
        if not is_policy(str(folder)):
            raise RecipeError(
                f"{folder} holds no policy yet: train one with `acwm policy train {name}`"
            )
        self._policy = policy_for(str(folder), card, task.name)
        self._estimator = estimator_for(card)
        if self._estimator is None and self._policy.observes == "state":
            raise DataError(f"no estimator reads the states of {card.name} from pictures")

    def begin(self, goal: Goal, still: NDArray[np.float32], seed: int) -> None:
        self._policy.reset(goal)

    def act(
        self,
        frames: Sequence[Frame],
        actions: Sequence[NDArray[np.float32]],
        check: Callable[[], None],
    ) -> Sequence[NDArray[np.float32]]:
        """See `Driver.act`: one decision, held as long as in training."""
        if self._policy.observes == "frame" or self._estimator is None:
            action = self._policy.predict(frames[-1])
        else:
            states = self._estimator.read(as_clip(frames[-1][None])).states
            action = self._policy.predict({name: values[0] for name, values in states.items()})
        return [action] * self._policy.card.repeat
