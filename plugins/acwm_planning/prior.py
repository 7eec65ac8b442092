"""`PolicyPrior`: what a trained policy would do next, as a proposal to a planner."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.task import Goal, Task
from acwm_core.errors import RecipeError
from acwm_core.model.shapes import Actions
from acwm_core.model.state_stream import StateStream
from acwm_planning.futures import History, ModelRollouts
from acwm_planning.policies.saved import policy_for


class PolicyPrior:
    """Lets a policy act on the states that a model predicts, from the current frame on.

    Args:
        name: the policy's folder.
        rollouts: of the model, which must carry states.

    Raises:
        RecipeError: the policy is of another environment, or decides at another rate than the
            model's latent frames.
    """

    def __init__(self, name: str, rollouts: ModelRollouts) -> None:
        self._name, self._rollouts = name, rollouts
        self._policy = policy_for(name, rollouts.card)
        stride = rollouts.world_model.codec.temporal_stride
        if self._policy.card.repeat != stride:
            raise RecipeError(
                f"the policy {name} holds an action for {self._policy.card.repeat} frames, but a "
                f"latent frame of the model has {stride}: give planner.prior another one"
            )
        if self._policy.observes == "frame":
            raise RecipeError(
                f"the policy {name} observes pictures, but a plan moves states: give planner.prior "
                "another one"
            )
        self._seen: Mapping[str, NDArray[np.float32]] | None = None

    def begin(self, task: Task, goal: Goal) -> None:
        """Start an episode.

        Raises:
            RecipeError: the policy was trained for another task.
        """
        policy_for(self._name, self._rollouts.card, task.name)
        self._goal, self._seen = goal, None

    @torch.no_grad()
    def actions(self, history: History, still: NDArray[np.float32], length: int) -> Actions:
        """The next raw actions `[length, A]` of the policy.

        Args:
            history: the episode so far.
            still: the action that means no motion, assumed before the start.
            length: number of actions.
        """
        world, policy = self._rollouts.world_model, self._policy
        video, recent = self._rollouts.recent(history, still)
        recent = recent.to(video.device)
        stride, between = world.codec.temporal_stride, video.shape[1] - 1
        stream = world.stream_states(video, recent[:, :between])
        policy.reset(self._goal)
        if self._seen is not None and recent.shape[1] == between:
            policy.predict(self._seen)  # so that it knows what has changed since
        for start in range(between, recent.shape[1], stride):
            policy.predict(_seen_in(stream))
            stream.step(recent[:, start : start + stride])
        self._seen, taken = _seen_in(stream), list[Tensor]()
        for _ in range(-(-length // stride)):
            action = torch.from_numpy(policy.predict(_seen_in(stream)))
            taken.append(action.expand(1, stride, -1))
            stream.step(taken[-1].to(recent))
        return torch.cat(taken, 1)[0, :length]


def _seen_in(stream: StateStream) -> Mapping[str, NDArray[np.float32]]:
    """The states of the only scene."""
    return {name: values[0].cpu().numpy() for name, values in stream.current.items()}
