"""`ClipStream`: clips from streamed shards, for datasets larger than the disk.

In every pass, the shards are dealt anew to the readers, i.e. the workers of all ranks, so that
clips are seen equally often. A reader draws the next clip from a buffer of compressed episodes. Of
a dataset behind a URL, the disk holds one shard per reader. The stream has no position, so it
cannot be resumed exactly.
"""

from __future__ import annotations

import heapq
import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils import data as torch_data

from acwm_core.data.clips import ClipDataset, window_actions
from acwm_core.data.dataset import window_into
from acwm_core.data.loader import ClipSampler, epoch_order
from acwm_core.data.shards import damaged_shard
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import DataError

default_collate = cast(Any, torch_data).default_collate  # it has no types


class _Window(NamedTuple):
    """A clip that is not decoded yet; windows of one episode share its bytes."""

    video: bytes
    actions: NDArray[np.float32]
    start: int
    frames: int
    length: int  # frames of the episode
    where: tuple[Path, int]  # the shard, and the episode's position in it
    symmetry: Symmetry | None  # that transforms the clip


class ClipStream(torch_data.IterableDataset[Any]):
    """Batches of clips without end, on every rank, for a `ClipLoader`.

    Args:
        clips: which clips; only their shards are read, each when its turn comes.
        sampler: its `batch_size`, `seed`, `rank` and `world_size` count, not its order.
        shuffle_buffer: size of each reader's buffer, in clips, from which the next one is drawn.
    """

    def __init__(
        self, clips: ClipDataset, sampler: ClipSampler, *, shuffle_buffer: int = 2000
    ) -> None:
        self.clips, self.sampler, self.shuffle_buffer = clips, sampler, shuffle_buffer
        episodes: list[int] = clips.windows[:, 0].tolist()
        self._shard_of = np.array([clips.episodes.shard_of(episode) for episode in episodes])
        self._pending: dict[int, list[dict[str, Tensor]]] = defaultdict(list)  # by clip length

    def __iter__(self) -> Iterator[Any]:
        """Yield batches; a `DataError` is the last item, as in `ClipLoader`."""
        import webdataset  # pyright: ignore[reportMissingTypeStubs]

        worker = torch_data.get_worker_info()
        workers, own = (worker.num_workers, worker.id) if worker else (1, 0)
        own += self.sampler.rank * workers
        size, seed = self.shuffle_buffer, self.sampler.seed
        try:
            for number, shares in enumerate(self._passes(self.sampler.world_size * workers)):
                windows = self._windows(shares[own])
                buffer = cast(Any, webdataset).detshuffle(size, size, seed, epoch=number - 1)
                yield from self._batches(buffer.run(windows))
        except DataError as error:
            yield error

    def _passes(self, readers: int) -> Iterator[list[list[int]]]:
        """The shards of each reader in each pass; the next one goes to who had the fewest clips.

        Readers take clips at the same rate. So whatever shards hold, and however few they are, no
        reader is ahead by more than one shard.
        """
        shards, clips = np.unique(self._shard_of, return_counts=True)
        dealt = [(0, reader) for reader in range(readers)]
        for number in itertools.count():
            shares: list[list[int]] = [[] for _ in range(readers)]
            for place in epoch_order(len(shards), self.sampler.seed, number):
                before, reader = dealt[0]
                shares[reader].append(int(shards[place]))
                heapq.heapreplace(dealt, (before + int(clips[place]), reader))
            yield shares

    def _windows(self, shards: Iterable[int]) -> Iterator[_Window]:
        clips, episodes = self.clips, self.clips.episodes
        owners: list[int] = clips.windows[:, 0].tolist()
        for number in shards:
            rows = np.flatnonzero(self._shard_of == number)
            with episodes.passing_shard(number) as reader:
                for episode, group in itertools.groupby(rows, owners.__getitem__):
                    place = episode - episodes.shards[number][0]
                    length, where = episodes.lengths[episode], (reader.path, place)
                    actions = reader.array(place, "actions.npy")
                    video = reader.read(place, "video.mkv")
                    for row in group:
                        start, frames = int(clips.windows[row, 1]), int(clips.lengths[row])
                        version = clips.version(int(row))
                        yield _Window(video, actions, start, frames, length, where, version)

    def _batches(self, windows: Iterable[_Window]) -> Iterator[dict[str, Tensor]]:
        """Batches of clips of one length; clips that do not fill a batch wait for the next pass."""
        for window in windows:
            pending = self._pending[window.frames]
            pending.append(self._decoded(window))
            if len(pending) == self.sampler.batch_size:
                yield default_collate(pending)
                pending.clear()

    def _decoded(self, window: _Window) -> dict[str, Tensor]:
        size = self.clips.episodes.card.environment.frame_size
        video = np.empty((window.frames, 3, *size), np.uint8)
        path, place = window.where
        try:
            window_into(video, window.video, window.start, window.length)
        except DataError as error:
            raise damaged_shard(path, f"video.mkv of episode {place}: {error}") from error
        actions = window_actions(window.actions, window.start, window.frames)
        if symmetry := window.symmetry:
            video, actions = symmetry.of_frames(video).copy(), symmetry.of_actions(actions)
        return {"video": torch.as_tensor(video), "actions": torch.as_tensor(actions)}
