"""`Scenes`: many scenes side by side of which only the states are known, dreamt or simulated."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import Goal
from acwm_core.errors import RecipeError, noting
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.state_stream import StateStream
from acwm_core.model.world_model import WorldModel
from acwm_dream.starts import DreamStart

States = Mapping[str, NDArray[Any]]
"""Fields of the state, by name, with an axis of scenes in front."""

READ_TOGETHER = 64
"""Number of starts that a model reads at once."""


class Scenes(ABC):
    """Scenes side by side that actions move.

    Args:
        number: number n of scenes.

    Attributes:
        number: the same.
        starts: number of different starts.
        repeat: video frames per step, for which an action is held.
    """

    starts: int
    repeat: int

    def __init__(self, number: int) -> None:
        self.number = number

    @abstractmethod
    def begin(self, which: Sequence[int], starts: Sequence[int]) -> tuple[States, list[Goal]]:
        """Begin some scenes anew.

        Args:
            which: their numbers, from 0.
            starts: the number of a start for each.

        Returns:
            Their states `[k, …]` and their goals.
        """

    @abstractmethod
    def step(self, actions: NDArray[np.float32]) -> States:
        """Hold raw actions `[n, A]` for a step; the states in its video frames `[n, repeat, …]`."""

    def move(self, actions: Tensor) -> dict[str, Tensor]:
        """As `step`, of tensors; in a dream, differentiable with respect to the actions."""
        states = self.step(actions.detach().numpy())
        return {name: torch.as_tensor(values) for name, values in states.items()}

    def only(self, fields: Collection[str]) -> None:  # noqa: B027 (most know all alike)
        """Go on for who needs these fields alone: the others may become NaN."""

    def detach(self) -> None:  # noqa: B027 (most have no gradients)
        """Forget the gradients of the steps so far."""

    def close(self) -> None:  # noqa: B027 (most hold nothing)
        """Free all resources."""


class DreamScenes(Scenes):
    """Scenes that a model moves, and never draws.

    Every start is read once, from its frames.

    Args:
        world: the world model, in evaluation mode, which carries states.
        starts: first frames and goals.
        number: number of scenes.

    Raises:
        RecipeError: the model predicts or carries no states.
    """

    def __init__(self, world: WorldModel, starts: Sequence[DreamStart], number: int) -> None:
        super().__init__(number)
        if not world.state_shapes:
            raise RecipeError(
                "the model predicts no states, so no policy can learn in it: train one that does "
                "(`acwm fit … +scene`)"
            )
        self._world = world.requires_grad_(False)
        self.starts, self.repeat = len(starts), world.codec.temporal_stride
        self._goals = [start.goal for start in starts]
        self._read = self._read_starts(starts)
        self._scenes = self._read.picked(torch.zeros(number, dtype=torch.int64))

    def begin(self, which: Sequence[int], starts: Sequence[int]) -> tuple[States, list[Goal]]:
        begun = self._read.picked(torch.tensor(starts))
        self._scenes.put(torch.tensor(which), begun)
        goals = [self._goals[start] for start in starts]
        return as_arrays(begun.current), [goal for goal in goals if goal is not None]

    def step(self, actions: NDArray[np.float32]) -> States:
        return as_arrays(self.move(torch.from_numpy(actions)))

    def move(self, actions: Tensor) -> dict[str, Tensor]:
        rows = actions.to(self._world.device)[:, None].expand(-1, self.repeat, -1)
        with noting("while the model moves the scenes", *self._world.children()):
            states = self._scenes.step(rows)
        return {name: values.cpu() for name, values in states.items()}

    def only(self, fields: Collection[str]) -> None:
        self._read, self._scenes = self._read.only(fields), self._scenes.only(fields)

    @torch.no_grad()
    def detach(self) -> None:
        self._scenes = self._scenes.picked(torch.arange(self.number))

    def _read_starts(self, starts: Sequence[DreamStart]) -> StateStream:
        whole: StateStream | None = None
        for first in range(0, len(starts), READ_TOGETHER):
            part = starts[first : first + READ_TOGETHER]
            frames = torch.stack([as_clip(start.frames) for start in part]).to(self._world.device)
            between = torch.from_numpy(np.stack([start.actions for start in part]))
            seeds = range(first, first + len(part))
            with noting("when the model reads the starts", *self._world.children()):
                read = self._world.stream_states(
                    frames, between.to(self._world.device), seeds=seeds
                )
            if whole is None:
                whole = read.picked(torch.zeros(len(starts), dtype=torch.int64))
            whole.put(torch.tensor(seeds), read)
        assert whole is not None
        return whole


class SimulatorScenes(Scenes):
    """The same scenes in the simulator, which moves one after the other and draws none.

    Args:
        card: card of the environment.
        specs: the episodes that scenes begin as.
        goals: their goals.
        repeat: video frames per step.
        number: number of scenes.
    """

    def __init__(
        self,
        card: EnvironmentCard,
        specs: Sequence[EpisodeSpec],
        goals: Sequence[Goal],
        repeat: int,
        number: int,
    ) -> None:
        super().__init__(number)
        self._specs, self._goals, self.repeat, self.starts = specs, goals, repeat, len(specs)
        options = {"size": card.frame_size}
        self._scenes = [make_environment(card.name, options) for _ in range(number)]

    def begin(self, which: Sequence[int], starts: Sequence[int]) -> tuple[States, list[Goal]]:
        states: list[States] = []
        for scene, start in zip(which, starts, strict=True):
            with noting("when a scene begins", self._scenes[scene]):
                self._scenes[scene].reset(options={"spec": self._specs[start]})
                states.append(self._scenes[scene].observe_state())
        return stacked(states), [self._goals[start] for start in starts]

    def step(self, actions: NDArray[np.float32]) -> States:
        return stacked([self._course(*pair) for pair in zip(self._scenes, actions, strict=True)])

    def _course(self, scene: Any, action: NDArray[np.float32]) -> States:
        states: list[States] = []
        with noting("while a scene is simulated", scene):
            for _ in range(self.repeat):
                scene.advance(action)
                states.append(scene.observe_state())
        return stacked(states)

    def close(self) -> None:
        for scene in self._scenes:
            scene.close()


def stacked(states: Sequence[States]) -> States:
    """Several states as one, along a new first axis."""
    return {name: np.stack([np.asarray(state[name]) for state in states]) for name in states[0]}


def as_arrays(states: Mapping[str, Tensor]) -> States:
    """States in NumPy, on the CPU."""
    return {name: values.detach().cpu().numpy() for name, values in states.items()}
