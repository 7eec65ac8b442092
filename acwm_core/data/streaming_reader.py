"""`StreamingLoader`: clips from streamed shards, for datasets larger than the disk.

It is a webdataset pipeline. Each worker of each rank has its own shards, in a new order in every
pass, and draws the next clip from a buffer of compressed episodes. Of a dataset behind a URL, the
disk holds one shard per worker. The stream has no position, so it cannot be resumed exactly.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset

from acwm_core.data.clips import ClipSampler, window_actions
from acwm_core.data.episodes import ClipDataset, window_into
from acwm_core.data.loader import ClipLoader, Fetched, default_collate
from acwm_core.data.shards import damaged_shard
from acwm_core.errors import DamagedShardError, DataError


class StreamingLoader(ClipLoader):
    """An endless stream of batches of clips, on every rank.

    Args:
        clips: which clips; only their shards are read, each when its turn comes.
        shuffle_buffer: size of each worker's buffer, in clips, from which the next one is drawn.
        skip_damaged: leave out damaged episodes, with a warning.
        workers, pin_memory: as in `ResumableLoader`.
        batches: `batch_size`, `seed`, `rank` and `world_size`, as in `ClipSampler`.

    Raises:
        DataError: there are fewer shards than processes to read them.
    """

    def __init__(
        self,
        clips: ClipDataset,
        *,
        shuffle_buffer: int = 2000,
        skip_damaged: bool = False,
        workers: int = 0,
        pin_memory: bool = False,
        **batches: Any,
    ) -> None:
        sampler = ClipSampler(len(clips), **batches)
        stream = _Stream(clips, sampler, shuffle_buffer, skip_damaged)
        shards, readers = len(stream.shards), sampler.world_size * max(1, workers)
        if shards < readers:
            raise DataError(
                f"data.reader=webdataset needs a shard for each of {readers} processes that read, "
                f"not {shards} in all: set fewer data.workers, or data.reader=random_access"
            )
        super().__init__(stream, sampler, workers, pin_memory)


class _Window(NamedTuple):
    """A clip that is not decoded yet; windows of one episode share its bytes."""

    video: bytes
    actions: NDArray[np.float32]
    start: int
    frames: int
    length: int  # frames of the episode
    where: tuple[Path, int]  # the shard, and the episode's position in it


@dataclass(eq=False)
class _Stream(IterableDataset[Fetched]):
    clips: ClipDataset
    sampler: ClipSampler
    shuffle_buffer: int
    skip_damaged: bool

    def __post_init__(self) -> None:
        self._skipped: list[str] = []
        self._pending: dict[int, list[dict[str, Tensor]]] = defaultdict(list)  # by clip length
        episodes: list[int] = self.clips.windows[:, 0].tolist()
        self._shard_of = np.array([self.clips.episodes.shard_of(each) for each in episodes])
        self.shards: list[int] = np.unique(self._shard_of).tolist()

    def __iter__(self) -> Iterator[Fetched]:
        """Yield batches without end; after an error, one item that holds its message."""
        import webdataset  # pyright: ignore[reportMissingTypeStubs]

        wds, everything = cast(Any, webdataset), len(self.shards)
        seed, own = self.sampler.seed, self.shards[self.sampler.rank :: self.sampler.world_size]
        pipeline = wds.DataPipeline(
            wds.SimpleShardList([str(number) for number in own]),
            wds.split_by_worker,
            wds.detshuffle(everything, initial=everything, seed=seed),
            self._windows,
            wds.detshuffle(self.shuffle_buffer, initial=self.shuffle_buffer, seed=seed),
            self._batches,
        ).repeat()
        try:
            yield from pipeline
        except DataError as error:  # else it would arrive as pages of traceback
            yield Fetched(None, [], str(error))

    def _windows(self, shards: Iterable[dict[str, str]]) -> Iterator[_Window]:
        clips, episodes = self.clips, self.clips.episodes
        owners: list[int] = clips.windows[:, 0].tolist()
        for shard in shards:
            number = int(shard["url"])
            rows = np.flatnonzero(self._shard_of == number)
            with self._skipping(), episodes.passing_shard(number) as reader:
                for episode, group in itertools.groupby(rows, owners.__getitem__):
                    place = episode - episodes.shards[number][0]
                    length, where = episodes.lengths[episode], (reader.path, place)
                    with self._skipping():
                        actions = episodes.actions_in(reader, place, length)
                        video = reader.read(place, "video.mkv")
                        for row in group:
                            start, frames = int(clips.windows[row, 1]), int(clips.lengths[row])
                            yield _Window(video, actions, start, frames, length, where)

    def _batches(self, windows: Iterable[_Window]) -> Iterator[Fetched]:
        """Batches of clips of one length; clips that do not fill a batch wait for the next pass."""
        sound = False
        for window in windows:
            pending = self._pending[window.frames]
            with self._skipping():
                pending.append(self._decoded(window))
                sound = True
            if len(pending) == self.sampler.batch_size:
                yield Fetched(default_collate(pending), self._skipped, None)
                self._skipped = []
                pending.clear()
        if not sound:
            raise DataError(f"all that this process reads is damaged: {self._skipped[-1]}")

    def _decoded(self, window: _Window) -> dict[str, Tensor]:
        size = self.clips.episodes.card.environment.frame_size
        video = np.empty((window.frames, 3, *size), np.uint8)
        path, place = window.where
        try:
            window_into(video, window.video, window.start, window.length)
        except DataError as error:
            raise damaged_shard(path, f"video.mkv of episode {place}: {error}") from error
        actions = window_actions(window.actions, window.start, window.frames)
        return {"video": torch.as_tensor(video), "actions": torch.as_tensor(actions)}

    @contextlib.contextmanager
    def _skipping(self) -> Generator[None]:
        try:
            yield
        except DamagedShardError as error:
            if not self.skip_damaged:
                raise
            self._skipped.append(str(error))
