"""Latents of clips: encoded once by a frozen codec, kept beside the clips, read at memory speed.

They lie in ``DATA/latents/<codec fingerprint>/<split>-<frames>x<stride>-<data checksum>/``, one
float16 array ``[clips, L, C, h, w]`` per shard. A card in that folder repeats these facts, so that
a renamed or copied folder is not misread.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.atomic import written_whole
from acwm_core.data.clips import common_length, window_actions, window_starts
from acwm_core.data.episodes import Clips, EpisodeDataset
from acwm_core.data.shards import UNREADABLE
from acwm_core.errors import DamagedShardError, DataError
from acwm_core.model.codec import Codec
from acwm_core.untrusted import parse_json, read_bytes

LATENTS = "latents"
CARD = "latents.json"


def compresses(codec: Codec) -> bool:
    """Whether float16 latents take less space than the 8-bit frames they encode."""
    return 2 * codec.channels < 3 * codec.spatial_stride**2 * codec.temporal_stride


@dataclass(frozen=True)
class LatentFolder:
    """The folder of the latents of a split's windows, with one file per shard."""

    episodes: EpisodeDataset  # the split
    fingerprint: str  # of the codec, `Codec.fingerprint()`
    frames: int  # frames of a window
    stride: int  # frames between the starts of an episode's windows

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w[\w.-]*", str(self.fingerprint)):
            raise DataError(f"the codec has the fingerprint {self.fingerprint!r}, not a valid name")

    @property
    def path(self) -> Path:
        """The folder."""
        episodes = self.episodes
        windows = f"{episodes.split}-{self.frames}x{self.stride}-{episodes.checksum[:12]}"
        return episodes.path / LATENTS / str(self.fingerprint) / windows

    def file(self, number: int, *, complete: bool = True) -> Path:
        """The file of shard `number`; an incomplete one has NaN for damaged episodes."""
        return self.path / f"shard-{number:05d}{'' if complete else '.incomplete'}.npy"

    def unfinished(self, skip_damaged: bool = False) -> list[int]:
        """Shards without latents. With `skip_damaged`, incomplete latents count as finished."""
        return [
            number
            for number in range(len(self.episodes.shards))
            if not self.file(number).exists()
            and not (skip_damaged and self.file(number, complete=False).exists())
        ]

    def starts(self, index: int) -> range:
        """First frames of the windows of an episode."""
        return window_starts(self.episodes.lengths[index], self.frames, self.stride)

    def keep_card(self) -> None:
        """Write the folder's card, or compare it with the one that is there.

        Raises:
            DataError: it holds other latents.
        """
        file, episodes = self.path / CARD, self.episodes
        card = {
            "codec": self.fingerprint,
            "split": episodes.split,
            "frames": self.frames,
            "stride": self.stride,
            "data": episodes.checksum,
        }
        if not file.exists():
            with written_whole(file) as partial:
                partial.write_text(json.dumps(card, indent=1), "utf-8")
        try:
            there = parse_json(read_bytes(file))
        except ValueError:
            there = None
        if there != card:
            raise DataError(
                f"{self.path} holds other latents than its name says, those of {there}: delete the "
                "folder and encode again"
            )


class LatentClipDataset(Clips):
    """The latents that `acwm_core.data.encoding.encode_windows` wrote, with the clips' actions.

    Args:
        episodes: the split they come from.
        fingerprint: of the codec, `Codec.fingerprint()`.
        skip_damaged: accept that damaged episodes were left out; only reading one raises.
        temporal_stride: as in `Clips`.
        windows: `frames` and `stride`, as they were encoded, and `indices`, `given` and
            `per_length`, as in `Clips`.

    Raises:
        DataError: these windows have not been encoded by that codec, or the latents are damaged.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        fingerprint: str,
        *,
        skip_damaged: bool = False,
        temporal_stride: int | None = None,
        **windows: Any,
    ) -> None:
        super().__init__(episodes, temporal_stride=temporal_stride, **windows)
        frames, stride = self.frames, self.stride
        folder = LatentFolder(episodes, fingerprint, frames, stride)
        if folder.unfinished(skip_damaged):
            others = sorted(path.name for path in (episodes.path / LATENTS).glob("*"))
            known = f" (there are latents of {', '.join(others)})" if others else ""
            raise DataError(
                f"{episodes.split} of {episodes.path} is not encoded by the codec {fingerprint} in "
                f"windows of {frames} frames every {stride}{known}: encode it with "
                f"`acwm encode {episodes.path} --codec NAME --split {episodes.split} "
                f"--frames {frames} --stride {stride}`"
            )
        folder.keep_card()
        self._temporal_stride = temporal_stride or 1
        missing = {*folder.unfinished()}
        self._files = [
            folder.file(number, complete=number not in missing)
            for number in range(len(episodes.shards))
        ]
        counts = [len(folder.starts(index)) for index in range(len(episodes))]
        # For every episode: its shard, and the row of its first window in the shard's array.
        self._places = [
            (number, sum(counts[first:index]))
            for number, (first, count) in enumerate(episodes.shards)
            for index in range(first, first + count)
        ]
        self._rows = [sum(counts[first : first + count]) for first, count in episodes.shards]
        self._layouts: dict[int, tuple[int, tuple[int, ...]]] = {}
        self._damaged = {
            index: f"shard {episodes.shard_path(shard)} was damaged when it was encoded"
            for index, (shard, row) in enumerate(self._places)
            if shard in missing and np.isnan(self._read(shard, row, 1)).any()
        }
        for episode in map(int, np.unique(self.windows[:, 0])):
            try:
                self._actions[episode] = episodes.actions(episode)
            except DamagedShardError as error:
                if not skip_damaged:
                    raise
                self._damaged.setdefault(episode, str(error))

    def batch(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """`latents` float16 ``[B, L, C, h, w]``, `actions` float32 ``[B, T, A]``, last rows zero.

        Raises:
            DamagedShardError: an episode of them is damaged and was left out.
        """
        frames = common_length(self.lengths, indices)
        # In a window padded with repeated frames, latents before the padding do not depend on it.
        kept = None if frames == self.frames else 1 + (frames - 1) // self._temporal_stride
        latents, actions = list[NDArray[np.float16]](), list[NDArray[np.float32]]()
        windows: list[tuple[int, int]] = self.windows[list(indices)].tolist()
        for episode, start in windows:
            if episode in self._damaged:
                raise DamagedShardError(self._damaged[episode])
            shard, row = self._places[episode]
            latents.append(self._read(shard, row + start // self.stride, kept))
            actions.append(window_actions(self._actions[episode], start, frames))
        return {
            "latents": torch.as_tensor(np.stack(latents)),
            "actions": torch.as_tensor(np.stack(actions)),
        }

    def _read(self, shard: int, row: int, kept: int | None) -> NDArray[np.float16]:
        """A window's latents, or the first `kept` of them, `[L, C, h, w]`.

        They are read, not memory-mapped: accessing the map of a truncated file would kill the
        process with SIGBUS.
        """
        offset, shape = self._layout(shard)
        latents = np.empty((kept or shape[0], *shape[1:]), np.float16)
        place = offset + row * math.prod(shape) * latents.itemsize
        file = self._files[shard]
        try:
            with file.open("rb", buffering=0) as opened:
                found = os.preadv(opened.fileno(), [latents.data], place)
            if found != latents.nbytes:
                raise ValueError("its end is cut off")
        except (ValueError, OSError) as error:
            raise _damaged(file, error) from error
        return latents

    def _layout(self, shard: int) -> tuple[int, tuple[int, ...]]:
        """The byte offset of a shard's latents in its file, and the shape of one window's."""
        if shard in self._layouts:
            return self._layouts[shard]
        file = self._files[shard]
        try:
            latents = np.load(file, mmap_mode="r", allow_pickle=False)
            expected = self._layout(0)[1] if shard else latents.shape[1:]
            if latents.dtype != np.float16 or latents.shape != (self._rows[shard], *expected):
                raise ValueError(f"they are {latents.dtype} {latents.shape}")
            if not latents.flags.c_contiguous:
                raise ValueError("they are in another order")
        except (OSError, *UNREADABLE) as error:
            raise _damaged(file, error) from error
        self._layouts[shard] = int(latents.offset), tuple(expected)
        return self._layouts[shard]


def _damaged(file: Path, error: Exception) -> DataError:
    why = f"the latents {file} are damaged ({error}): delete the file and encode again"
    return DataError(why)
