"""`EpisodeDataset`: the episodes of one split of a data folder, in random access."""

from __future__ import annotations

import contextlib
from bisect import bisect_right
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard
from acwm_core.data.manifest import Manifest, ShardRecord
from acwm_core.data.remote import data_folder, fetch_shard, origin
from acwm_core.data.shards import ShardReader, damaged_shard, open_shard
from acwm_core.data.video import Limits, decode_into, decode_planes
from acwm_core.episode import Episode, Split
from acwm_core.errors import DataError


class EpisodeDataset:
    """A sequence of `Episode`s. It keeps no file open and may cross into other processes.

    Args:
        path: the data folder, or its URL; then shards are fetched when they are first used and
            kept in a cache (see `acwm_core.data.remote`).
        split: which of its splits.

    Attributes:
        path: the local data folder, which for a URL lies in the cache.
        card: the folder's card.
        lengths: frames of every episode.
        checksum: hash of everything the split holds.
        shards: per shard the index of its first episode and its number of episodes.

    Raises:
        DataError: no such folder or split, or its generation was not finished.
    """

    def __init__(self, path: str | Path, split: Split) -> None:
        self.path, self.split = data_folder(path), split
        self.card = DatasetCard.read(self.path)
        if split not in self.card.splits:
            known = ", ".join(self.card.splits)
            made_here = not self.card.source and origin(self.path) is None
            add = f": add it with `{self.card.command(path, split)}`" if made_here else ""
            raise DataError(f"{path} has no split {split!r}, only {known}{add}")
        manifest = Manifest(self.path / split)
        records = manifest.ordered()
        self.lengths = [length for record in records for length in record.lengths]
        wanted = self.card.splits[split]
        if len(self.lengths) != wanted:
            raise DataError(
                f"{split} of {path} holds {len(self.lengths)} of its {wanted} episodes: run the "
                "command that makes it again, for the others"
            )
        self.checksum = manifest.checksum()
        self.shards = [(record.first, record.episodes) for record in records]
        self._records, self._origin = records, origin(self.path)

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, index: int) -> Episode:
        """Everything about one episode.

        Raises:
            IndexError: beyond the end.
            DataError: its shard is missing or damaged.
        """
        reader, position = self._locate(index)
        return reader.episode(position, self.card.environment.frame_size)

    def __iter__(self) -> Iterator[Episode]:
        return (self[index] for index in range(len(self)))

    def video(self, index: int, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Frames `start` to `stop` of an episode, ``[T, 3, H, W]`` uint8."""
        limits = Limits(self.lengths[index], self.card.environment.frame_size)
        with self._stored_video(index) as data:
            return decode_planes(data, start, stop, limits)

    def video_into(self, target: NDArray[np.uint8], index: int, start: int) -> None:
        """Write frames of an episode to `target` ``[T, 3, H, W]`` uint8, from `start` on."""
        limits = Limits(self.lengths[index], self.card.environment.frame_size)
        with self._stored_video(index) as data:
            decode_into(target, data, start, limits)

    def actions(self, index: int) -> NDArray[np.float32]:
        """The raw actions of an episode, ``[T, A]``."""
        reader, position = self._locate(index)
        actions = cast(NDArray[np.float32], reader.array(position, "actions.npy"))
        wanted = (self.lengths[index], self.card.environment.action.size)
        if actions.shape != wanted:
            reason = f"actions.npy of episode {position} are {actions.shape}, not {wanted}"
            raise damaged_shard(reader.path, reason)
        return actions

    def about(self, index: int) -> dict[str, Any]:
        """Spec, factors, ood_label and versions of an episode, without decoding it."""
        reader, position = self._locate(index)
        return reader.about(position)

    def shard_path(self, index: int) -> Path:
        """The file that holds an episode."""
        shard = bisect_right(self.shards, (index, len(self))) - 1
        return self.path / self.split / self._records[shard].shard

    @contextlib.contextmanager
    def _stored_video(self, index: int) -> Generator[bytes]:
        """The bytes of an episode's video; what goes wrong in decoding them names the shard."""
        reader, position = self._locate(index)
        data = reader.read(position, "video.mkv")
        try:
            yield data
        except DataError as error:
            reason = f"video.mkv of episode {position}: {error}"
            raise damaged_shard(reader.path, reason) from error

    def _locate(self, index: int) -> tuple[ShardReader, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        index %= len(self)
        shard = bisect_right(self.shards, (index, len(self))) - 1
        return open_shard(self._fetched(self._records[shard])), index - self.shards[shard][0]

    def _fetched(self, record: ShardRecord) -> Path:
        path = self.path / self.split / record.shard
        if self._origin and not path.exists():
            fetch_shard(f"{self._origin}/{self.split}/{record.shard}", path, record)
        return path
