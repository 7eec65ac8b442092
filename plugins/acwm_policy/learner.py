"""The `Learner` interface: what makes a policy of a lesson."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from torch import nn

from acwm_core.recipe.signature import Parameter, signature
from acwm_policy.lesson import Lesson, Place

Report = Callable[[int], object]
"""Takes the number of steps since it was last called."""


class Learner(ABC):
    """Learns a policy. The parameters of its constructor are set by their names.

    It is made, it begins, and it learns in stages; between them it may be saved and replaced by
    another one of the same parameters, which goes on as if nothing had been. Results depend on the
    parameters, the lesson and the seed alone.

    Attributes:
        places: what it can learn from, the usual one first.
        usual_steps: number of steps by default.
        steps: number of steps so far.
        hold: of recordings, number of frames for which an action of the policy is held.
        chunk: of recordings, number of actions that it decides on at once.
        picture: of recordings, longer side of the pictures that it observes, in pixels.
    """

    places: ClassVar[tuple[Place, ...]] = ("dream", "simulator")
    usual_steps: ClassVar[int] = 200_000
    steps: int = 0
    hold: int = 4
    chunk: int = 1
    picture: int = 48

    @classmethod
    def parameters(cls) -> Mapping[str, Parameter]:
        """The parameters that can be set, with their types and defaults."""
        return signature(cls).parameters

    @abstractmethod
    def begin(self, lesson: Lesson, seed: int) -> None:
        """Make what learns.

        Args:
            lesson: what to learn from: scenes to act in (`lesson.episodes`) or recordings
                (`lesson.recordings`), as `places` says.
            seed: of all randomness.

        Raises:
            RecipeError: a parameter is out of range.
        """

    @abstractmethod
    def learn(self, steps: int, report: Report) -> None:
        """Go on until `self.steps` is at least `steps`. All scenes begin anew.

        Args:
            steps: number of steps in all.
            report: is called now and then.
        """

    @abstractmethod
    def network(self) -> nn.Sequential:
        """The policy so far: maps observations `[N, O]` to actions `[N, A]` in [-1, 1].

        It consists of layers of `acwm_planning.policies.networks`.
        """

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that it needs to go on: tensors, numbers and text in dicts and lists."""

    @abstractmethod
    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on, after `begin`, as the learner did whose `state` this is."""

    def forget(self) -> None:  # noqa: B027 (most keep nothing of what has passed)
        """Forget what has passed in a dream, as what follows is another model's."""
