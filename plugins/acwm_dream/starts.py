"""Starts of dreams: frames from the simulator or a dataset, or a picture from the user."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import DataError, RecipeError, noting, suggest


class DreamStart(NamedTuple):
    """What a model is given at the start."""

    frames: NDArray[np.uint8]  # `[K, H, W, 3]`; the last one is the current frame
    actions: NDArray[np.float32]  # raw actions between the frames, `[K − 1, A]`
    goal: Goal | None  # goal of the task, if there is a task


class Starts(ABC):
    """Draws starts.

    Attributes:
        options: names of the supported options of `reset`.
    """

    options: tuple[str, ...]

    @abstractmethod
    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> DreamStart:
        """Draw a start.

        Raises:
            RecipeError, DataError: the requested start is not possible.
        """

    def close(self) -> None:  # noqa: B027 (most hold nothing)
        """Free all resources."""


class SimulatorStarts(Starts):
    """First frames of the simulator, with no motion during the K context frames.

    Args:
        card: card of the environment, with the frame size.
        given: number K of context frames.
        task: task that samples goals, if there is one.
    """

    options = ("spec", "split", "factors")

    def __init__(self, card: EnvironmentCard, given: int, task: Task | None) -> None:
        self._inner, self._given = make_environment(card.name, {"size": card.frame_size}), given
        self._environment = self._inner if task is None else TaskEnvironment(self._inner, task)

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> DreamStart:
        """The options are those of `Environment.reset`."""
        with noting("when a dream begins", self._inner):
            seed = int(rng.integers(2**31))
            frame, info = self._environment.reset(seed=seed, options=dict(options))
            frames, actions = [frame], list[NDArray[np.float32]]()
            for _ in range(self._given - 1):
                actions.append(self._inner.still_action())
                self._inner.advance(actions[-1])
                frames.append(self._inner.render())
        between = np.array(actions, np.float32).reshape(-1, self._inner.card.action.size)
        return DreamStart(np.stack(frames), between, info.get("goal"))

    def close(self) -> None:
        self._inner.close()


class DatasetStarts(Starts):
    """First frames of a dataset's episodes; the goal is the last frame of the episode.

    No simulator is needed.

    Args:
        episodes: episodes of one split.
        given: number K of context frames.
    """

    options = ("episode",)

    def __init__(self, episodes: EpisodeDataset, given: int) -> None:
        self._episodes, self._given = episodes, given

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> DreamStart:
        """The option ``{"episode": number}`` selects an episode."""
        number = options.get("episode", int(rng.integers(len(self._episodes))))
        if not isinstance(number, int) or not 0 <= number < len(self._episodes):
            raise RecipeError(f"episode={number!r}: give 0 to {len(self._episodes) - 1}")
        episode, given = self._episodes[number], self._given
        if len(episode.video) <= given:
            raise DataError(
                f"episode {number} is too short: it needs more than the {given} context frames"
            )
        state = {name: values[-1] for name, values in episode.states.items()}
        goal = Goal(state, episode.masks[-1], episode.video[-1])
        return DreamStart(episode.video[:given], episode.actions[: given - 1], goal)


def check_options(options: Mapping[str, Any], starts: Starts) -> None:
    """Refuse unknown options.

    Raises:
        RecipeError: an option is unknown; suggests the closest name.
    """
    names = ("frame", "goal", *starts.options)
    for name in options:
        if name not in names:
            raise RecipeError(f"unknown option {name!r} of reset{suggest(name, names)}")


def picture_start(card: EnvironmentCard, given: int, frame: Any, goal: Goal | None) -> DreamStart:
    """Start from a picture, without motion, under the actions nearest to zero.

    Raises:
        RecipeError: the picture is not a uint8 frame of the right size.
    """
    shape = (*card.frame_size, 3)
    picture = np.asarray(frame)
    if picture.shape != shape or picture.dtype != np.uint8:
        raise RecipeError(
            f"the frame to start from is uint8 {list(shape)}, not {picture.dtype} "
            f"{list(picture.shape)}"
        )
    low, high = card.action.low, card.action.high
    still = np.clip(np.zeros(card.action.size, np.float32), low, high, dtype=np.float32)
    frames = np.repeat(picture[None], given, 0)
    return DreamStart(frames, np.tile(still, (given - 1, 1)).reshape(-1, card.action.size), goal)
