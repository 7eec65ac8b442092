"""Predictions in files as a model that evaluation can ask."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_benchmark.lossy import Lossless, LossyVideo
from acwm_benchmark.predictions import Predictions
from acwm_benchmark.tasks import BenchmarkTask, Tasks
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import draw_seeds
from acwm_core.model.shapes import Actions, Video
from acwm_core.model.world_model import Mode

TOLERANCE = 1e-4
"""Share of an action's range by which it may differ, as other machines round otherwise."""


class HandedIn:
    """A `VideoModel` that knows the clips of some tasks, and nothing else.

    A draw of a clip is found by the seed of its noise, which stands for the clip's start and for
    the number of the draw, and by the actions.
    """

    steps = None
    device = torch.device("cpu")

    def __init__(self, tasks: Tasks, predictions: Predictions) -> None:
        world = predictions.world
        self.clip_frames = world.branch_frames
        self.context_frames = int(world.evaluation["context_frames"])
        coding = predictions.coding
        self.codec = Lossless()
        if coding is not None:
            self.codec = LossyVideo(coding, predictions.samples(), world.fps)
        self.samples = predictions.draws > 1
        self._predictions = predictions
        self._span = np.subtract(world.actions["high"], world.actions["low"])
        self._known: dict[int, list[tuple[BenchmarkTask, int, NDArray[np.float32]]]] = {}
        for task in predictions.tasks.values():
            actions = tasks.actions(task)
            for draw, seed in enumerate(draw_seeds(task.seed, len(predictions.files[task.id]))):
                self._known.setdefault(seed, []).append((task, draw, actions))

    def children(self) -> Iterable[object]:
        """Nothing whose author could be named in an error."""
        return []

    def rollout_chunks(
        self,
        given: Video,
        actions: Actions,
        *,
        mode: Mode | None,
        steps: int | None,
        seeds: Sequence[int] | None,
    ) -> Iterator[Video]:
        """The predicted clips, in one chunk; see `WorldModel.rollout_chunks`."""
        rows = actions.cpu().numpy()
        videos = [self._clip(seed, own) for seed, own in zip(seeds or (), rows, strict=True)]
        yield torch.stack(videos)

    def _clip(self, seed: int, actions: NDArray[np.float32]) -> torch.Tensor:
        for task, draw, own in self._known.get(seed, ()):
            if own.shape == actions.shape and np.all(abs(own - actions) <= TOLERANCE * self._span):
                video = self._predictions.video(task.id, draw)
                return torch.as_tensor(np.ascontiguousarray(video.transpose(0, 3, 1, 2)))
        world = self._predictions.world.name
        raise DataError(
            f"the tasks of {world} lack a clip that the test data has: export them again"
        )
