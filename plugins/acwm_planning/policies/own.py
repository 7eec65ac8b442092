"""Users' own policies: a function, an object with `predict`, or a torch module."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.errors import PluginError, RecipeError, noting
from acwm_core.evaluation.clips import as_clip
from acwm_core.recipe.trust import import_named
from acwm_planning.controllers import Actions, Controller
from acwm_planning.futures import History
from acwm_planning.policies.saved import is_policy, policy_for


class OwnPolicy:
    """A user's policy, asked for an action once per latent frame.

    It is named by the folder of a policy that `acwm policy train` has trained, or by
    ``module:name``, which is one of the following, or a class that creates one when called without
    arguments:

    * a torch module: takes a frame ``[1, 3, H, W]`` in [0, 1] and returns ``[1, A]``;
    * an object with `predict`, as in stable-baselines3: takes ``[H, W, 3]`` uint8 and returns an
      action ``[A]``, or a tuple that begins with it;
    * any other callable: takes and returns the same as `predict`.

    With an attribute ``observes = "state"`` it gets the states that an estimator reads, a mapping
    by field, instead of the frame. If it has a method `reset`, this is called with the `Goal` when
    an episode starts.

    Args:
        name: ``module:name`` of the policy, or its folder.
        card: card of the environment.

    Raises:
        RecipeError, PluginError: there is no such policy, or it cannot act.
    """

    def __init__(self, name: str, card: EnvironmentCard) -> None:
        self.name, self._card = name, card
        policy: Any = policy_for(name, card) if is_policy(name) else None
        policy = import_named(name, f"the policy {name}") if policy is None else policy
        if isinstance(policy, type):
            policy = self._call("made", policy)
        if not (callable(getattr(policy, "predict", None)) or callable(policy)):
            raise RecipeError(f"the policy {name} is not callable and has no predict()")
        self._policy: Any = policy.eval() if isinstance(policy, torch.nn.Module) else policy
        self.observes = getattr(policy, "observes", "frame")
        if self.observes not in ("frame", "state"):
            raise RecipeError(f"the policy {name} observes {self.observes!r}: frame or state")

    def reset(self, goal: Goal) -> None:
        """Start an episode."""
        reset = getattr(self._policy, "reset", None)
        if callable(reset):
            self._call("reset", reset, copy.deepcopy(goal))  # the policy may modify it

    def act(self, frame: Frame, state: Mapping[str, NDArray[Any]] | None) -> NDArray[np.float32]:
        """Choose the next action `[A]`, clipped to its bounds.

        Args:
            frame: the current frame, `[H, W, 3]` uint8.
            state: states that an estimator read from it, if the policy observes them.

        Raises:
            PluginError: the policy does not return an action.
        """
        if isinstance(self._policy, torch.nn.Module) and self.observes == "frame":
            picture = torch.from_numpy(np.array(frame)).permute(2, 0, 1)[None] / 255
            with torch.no_grad():
                answer = self._call("called", self._policy, picture)
            answer = answer[0].cpu().numpy() if isinstance(answer, torch.Tensor) else answer
        else:
            act = getattr(self._policy, "predict", self._policy)
            answer = self._call("called", act, frame if self.observes == "frame" else state)
            answer = answer[0] if isinstance(answer, tuple) else answer
        spec = self._card.action
        action = np.asarray(answer)
        if action.shape != (spec.size,) or not is_finite(action):
            raise PluginError(
                f"the policy {self.name} returned an array of shape {np.shape(answer)}, but "
                f"{self._card.name} needs {spec.size} finite numbers"
            )
        return np.clip(action.astype(np.float32), spec.low, spec.high, dtype=np.float32)

    def decide(self, frame: Frame, estimator: StateEstimator | None) -> NDArray[np.float32]:
        """The next action for a frame, of which an estimator reads the states if it needs them."""
        state = None
        if self.observes == "state" and estimator is not None:
            observation = estimator.read(as_clip(frame[None]))
            state = {name: values[0] for name, values in observation.states.items()}
        return self.act(frame.copy(), state)  # the policy may modify the frame

    def _call(self, doing: str, function: Any, *arguments: Any) -> Any:
        with noting(f"when the policy {self.name} was {doing}", self.name):
            return function(*arguments)


class OwnController(Controller):
    """Lets a user's policy act in the simulator.

    Args:
        policy: the policy.
        estimator: reads the states for it.
        stride: number of actions for which its action is held.
    """

    def __init__(self, policy: OwnPolicy, estimator: StateEstimator | None, stride: int) -> None:
        self._policy, self._estimator, self._stride = policy, estimator, stride

    def begin(self, environment: Environment, task: Task, goal: Goal) -> None:
        self._policy.reset(goal)

    def act(self, history: History) -> Actions:
        return [self._policy.decide(history.frames[-1], self._estimator)] * self._stride


def is_finite(numbers: NDArray[Any]) -> bool:
    """Whether all are finite real numbers."""
    return numbers.dtype.kind in "fiu" and bool(np.isfinite(numbers).all())
