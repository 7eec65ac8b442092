"""Random access to the episodes of a split, and to clips of them."""

from __future__ import annotations

import contextlib
import tempfile
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import clip_lengths, common_length, list_windows, window_actions
from acwm_core.data.manifest import Manifest
from acwm_core.data.remote import data_folder, fetch_shard, origin
from acwm_core.data.shards import ShardReader, damaged_shard, open_shard
from acwm_core.data.video import Limits, decode_into, decode_planes
from acwm_core.env.episode import Episode, Split
from acwm_core.errors import DataError

if TYPE_CHECKING:  # reading episodes needs no torch
    from torch import Tensor


class EpisodeDataset:
    """A sequence of `Episode`s. It keeps no file open and can be sent to other processes.

    Args:
        path: the data folder, or its URL. Shards behind a URL are fetched on first use and kept in
            a cache (see `acwm_core.data.remote`).
        split: which of its splits.

    Attributes:
        path: the local data folder; for a URL, its folder in the cache.
        card: the folder's card.
        lengths: number of frames of every episode.
        checksum: hash of everything the split holds.
        shards: for each shard, the index of its first episode and its number of episodes.

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
        wanted = self.card.splits[split]
        manifest = Manifest(self.path / split, wanted)
        records = manifest.ordered()
        self.lengths = [length for record in records for length in record.lengths]
        if len(self.lengths) != wanted:
            raise DataError(
                f"{split} of {path} holds {len(self.lengths)} of its {wanted} episodes: run the "
                "command that made it again to add the others"
            )
        self.checksum = manifest.checksum()
        self.shards = [(record.first, record.episodes) for record in records]
        self._records, self._origin = records, origin(self.path)

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, index: int) -> Episode:
        """Read one episode with everything that was recorded of it.

        Raises:
            IndexError: there is no such episode.
            DataError: its shard is missing or damaged.
        """
        reader, position = self._locate(index)
        return reader.episode(position, self.card.environment.frame_size)

    def __iter__(self) -> Iterator[Episode]:
        return (self[index] for index in range(len(self)))

    def video(self, index: int, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Frames `start` to `stop` of an episode, ``[T, 3, H, W]`` uint8."""
        limits = Limits(self.lengths[index], self.card.environment.frame_size)
        reader, position = self._locate(index)
        with reader.decoding(position, "video.mkv") as data:
            return decode_planes(data, start, stop, limits)

    def video_into(self, target: NDArray[np.uint8], index: int, start: int) -> None:
        """Decode frames of an episode, from frame `start` on, into `target` ``[T, 3, H, W]`` uint8.

        After the end of the episode its last frame is repeated.
        """
        reader, position = self._locate(index)
        with reader.decoding(position, "video.mkv") as data:
            window_into(target, data, start, self.lengths[index])

    def actions(self, index: int) -> NDArray[np.float32]:
        """The raw actions of an episode, ``[T, A]``."""
        return self.actions_in(*self._locate(index), self.lengths[index])

    def actions_in(self, reader: ShardReader, position: int, length: int) -> NDArray[np.float32]:
        """The raw actions ``[length, A]`` of the episode at `position` in a shard."""
        actions = cast(NDArray[np.float32], reader.array(position, "actions.npy"))
        wanted = (length, self.card.environment.action.size)
        if actions.shape != wanted:
            reason = f"actions.npy of episode {position} are {actions.shape}, not {wanted}"
            raise damaged_shard(reader.path, reason)
        return actions

    def about(self, index: int) -> dict[str, Any]:
        """Spec, factors, ood_label and versions of an episode, without decoding its video."""
        reader, position = self._locate(index)
        return reader.about(position)

    def shard_of(self, index: int) -> int:
        """The number of the shard that holds an episode."""
        return bisect_right(self.shards, (index, len(self))) - 1

    def shard_path(self, number: int) -> Path:
        """The path of shard `number`."""
        return self.path / self.split / self._records[number].shard

    @contextlib.contextmanager
    def passing_shard(self, number: int) -> Generator[ShardReader]:
        """Open shard `number` for a while. If it must be fetched, it is not added to the cache.

        Raises:
            DataError: it is missing or damaged, or cannot be fetched.
        """
        path = self.shard_path(number)
        if self._origin is None or path.exists():
            yield open_shard(path)
            return
        with tempfile.TemporaryDirectory(prefix="acwm-") as folder:
            yield open_shard(self._fetched(number, Path(folder, path.name)))

    def _locate(self, index: int) -> tuple[ShardReader, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        index %= len(self)
        number = self.shard_of(index)
        path = self._fetched(number, self.shard_path(number))
        return open_shard(path), index - self.shards[number][0]

    def _fetched(self, number: int, path: Path) -> Path:
        if self._origin and not path.exists():
            record = self._records[number]
            fetch_shard(f"{self._origin}/{self.split}/{record.shard}", path, record)
        return path


def window_into(target: NDArray[np.uint8], data: bytes, start: int, length: int) -> None:
    """Decode a window of an episode's video, from frame `start` on, into `target` ``[T, 3, H, W]``.

    After the end of the episode, which has `length` frames, its last frame is repeated.

    Raises:
        DataError: the bytes are not such a video.
    """
    held = min(len(target), length - start)
    decode_into(target[:held], data, start, Limits(length))
    target[held:] = target[held - 1]


class Clips(ABC):
    """The windows of a split's episodes as a map-style dataset of clips.

    Args:
        episodes: where the clips come from.
        frames: frames of a clip, T; a shorter episode gives one clip.
        stride: frames between the starts of an episode's clips.
        indices: only these episodes, e.g. those of `hold_out`; all by default.
        temporal_stride: temporal stride of the codec. Clips of shorter episodes are then cut to
            whole latent frames; by default they repeat their last frame with zero actions.
        given: context frames of a clip; every clip has at least one latent frame more to predict.
        per_length: how many clips should share a length, as those of a batch do; see
            `shared_lengths`.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip.
        lengths: number of video frames of each clip; see `clip_lengths` and `shared_lengths`.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
        temporal_stride: int | None = None,
        given: int = 1,
        per_length: int = 1,
    ) -> None:
        self.episodes, self.frames, self.stride = episodes, frames, stride
        self.windows = list_windows(episodes.lengths, frames, stride, indices)
        self.lengths = clip_lengths(
            self.windows, episodes.lengths, frames, temporal_stride, given, per_length
        )
        self._actions: dict[int, NDArray[np.float32]] = {}  # of recently used episodes

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """One clip: the arrays of `batch` without the batch axis."""
        return {name: values[0] for name, values in self.batch([index]).items()}

    @abstractmethod
    def batch(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Read clips of one length as a batch, which is faster than one by one.

        Raises:
            DataError: a shard is missing or damaged.
        """


class ClipDataset(Clips):
    """Clips as video."""

    def batch(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """`video` uint8 ``[B, T, 3, H, W]``, `actions` float32 ``[B, T, A]``, last rows zero."""
        import torch

        frames, card = common_length(self.lengths, indices), self.episodes.card.environment
        video = np.empty((len(indices), frames, 3, *card.frame_size), np.uint8)
        actions = np.empty((len(indices), frames, card.action.size), np.float32)
        windows: list[tuple[int, int]] = self.windows[list(indices)].tolist()
        for row, (episode, start) in enumerate(windows):
            self.episodes.video_into(video[row], episode, start)
            actions[row] = window_actions(self._actions_of(episode), start, frames)
        return {"video": torch.as_tensor(video), "actions": torch.as_tensor(actions)}

    def _actions_of(self, episode: int) -> NDArray[np.float32]:
        if episode not in self._actions:
            if len(self._actions) == 2**14:  # a limit for memory; actions are small
                self._actions.clear()
            self._actions[episode] = self.episodes.actions(episode)
        return self._actions[episode]
