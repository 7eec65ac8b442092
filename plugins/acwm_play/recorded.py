"""A recorded video in the place of a simulator: what happened, beside what the model predicts.

The user drives the model alone; the video continues as recorded. If the recorded actions
drive, both should show the same.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.task import Goal
from acwm_core.errors import DataError, RecipeError
from acwm_play.simulator import SceneSpec, TaskProgress, TimeStep


class RecordedVideo:
    """Stands in for a `SimulatorProcess`, with the episodes of a dataset as scenes.

    Args:
        data: the data folder; its test episodes in distribution if it has any.
        size: height and width of frames.

    Raises:
        RecipeError: the frames have another size.
    """

    pointing = None
    alive = True
    scenes: int
    """Number of episodes, which are the scenes."""

    def __init__(self, data: Path, size: tuple[int, int]) -> None:
        first = EpisodeDataset(data, "train")
        tests = "ind_test" in first.card.splits
        self._data = EpisodeDataset(data, "ind_test") if tests else first
        self.card, self.scenes = first.card.environment, len(self._data)
        if size != self.card.frame_size:
            height, width = self.card.frame_size
            raise RecipeError(f"--size does not apply: the video in {data} is {height}×{width}")
        self._video: NDArray[np.uint8] = np.zeros((0, *size, 3), np.uint8)
        self._actions = np.zeros((0, self.card.action.size), np.float32)
        self._at = 0

    async def start(self, scene: SceneSpec, frames: int) -> list[TimeStep]:
        """The first `frames` frames of an episode."""
        index = scene.index % self.scenes
        video = self._data.video(index).transpose(0, 2, 3, 1)
        if len(video) <= frames:
            raise DataError(f"episode {index} has {len(video)} frames, and {frames} are given")
        self._video, self._actions = video, self._data.actions(index)
        self._at = frames - 1
        none = np.zeros_like(self._actions[0])
        actions = [none, *self._actions[: frames - 1]]
        return [self._shown(t, action) for t, action in enumerate(actions)]

    async def step(self, action: NDArray[np.float32]) -> TimeStep:
        """The next frame of the video, whatever the action; the last one repeats."""
        self._at = min(self._at + 1, len(self._video) - 1)
        bounds = (
            np.asarray(end, np.float32) for end in (self.card.action.low, self.card.action.high)
        )
        return self._shown(self._at, np.clip(np.asarray(action, np.float32), *bounds))

    async def step_by_policy(self, anew: bool) -> TimeStep:
        """The next frame of the video and the action that led to it."""
        if self._at + 1 >= len(self._video):
            raise DataError("the recording has ended: start a new scene")
        return await self.step(self._actions[self._at])

    async def still(self) -> NDArray[np.float32]:
        """The action nearest to zero."""
        low, high = self.card.action.low, self.card.action.high
        return np.clip(np.zeros(self.card.action.size, np.float32), low, high, dtype=np.float32)

    async def aim(self, task: str) -> tuple[Goal, TaskProgress]:
        """There is no goal in a recording."""
        raise RecipeError(f"{self.card.name} is recorded and has no task {task!r}")

    async def close(self) -> None:
        """Nothing is to be freed."""

    def _shown(self, at: int, action: NDArray[np.float32]) -> TimeStep:
        mask = np.zeros(self._video.shape[1:3], np.uint8)
        return TimeStep(self._video[at], mask, {}, (), {}, None, action)
