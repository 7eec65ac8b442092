"""Latents of clips: encoded once by a frozen codec, kept beside the clips, read at memory speed.

They lie in ``DATA/latents/<codec fingerprint>/<split>-<frames>x<stride>-<data checksum>/``, one
memory-mapped float16 array ``[clips, L, C, h, w]`` per shard. Another codec, other weights, other
windows or other data mean another folder, and a `LatentsCard` in it repeats them, so that nothing
is ever misread, not even by way of a folder that was renamed or copied.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.codec import Codec
from acwm_core.data.atomic import written_whole
from acwm_core.data.clips import (
    clip_lengths,
    common_length,
    list_windows,
    window_actions,
    window_starts,
)
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.errors import DamagedShardError, DataError

LATENTS = "latents"
CARD = "latents.json"


class LatentClip(TypedDict):
    """A clip: `latents` float16 ``[L, C, h, w]``, `actions` float32 ``[T, A]``, last row zero."""

    latents: Tensor
    actions: Tensor


def latent_folder(episodes: EpisodeDataset, fingerprint: str, frames: int, stride: int) -> Path:
    """Where the latents of these windows by the codec of that fingerprint are kept."""
    windows = f"{episodes.split}-{frames}x{stride}-{episodes.checksum[:12]}"
    return episodes.path / LATENTS / fingerprint / windows


def latent_file(folder: Path, number: int) -> Path:
    """The latents of shard `number`."""
    return folder / f"shard-{number:05d}.npy"


def incomplete_file(folder: Path, number: int) -> Path:
    """The latents of shard `number` where damaged episodes were left out, as NaN."""
    return folder / f"shard-{number:05d}.incomplete.npy"


def unfinished(episodes: EpisodeDataset, folder: Path, skip_damaged: bool = False) -> list[int]:
    """Shards whose latents are not in `folder`; incomplete ones will do if damage is skipped."""
    return [
        number
        for number in range(len(episodes.shards))
        if not latent_file(folder, number).exists()
        and not (skip_damaged and incomplete_file(folder, number).exists())
    ]


def compresses(codec: Codec) -> bool:
    """Whether latents in float16 take less room than the 8-bit frames they stand for."""
    pixels = 3 * codec.spatial_stride**2 * codec.temporal_stride
    return 2 * codec.channels < pixels


@dataclass(frozen=True)
class LatentsCard:
    """What a folder of latents holds: the codec's fingerprint, the windows, the data's checksum."""

    codec: str
    split: str
    frames: int
    stride: int
    data: str

    @classmethod
    def of(
        cls, episodes: EpisodeDataset, fingerprint: str, frames: int, stride: int
    ) -> LatentsCard:
        """The card of these windows of `episodes` by the codec of that fingerprint."""
        return cls(fingerprint, episodes.split, frames, stride, episodes.checksum)

    def keep(self, folder: Path) -> None:
        """Write this card to `folder`, or compare it with the one there.

        Raises:
            DataError: the folder holds other latents.
        """
        file = folder / CARD
        if not file.exists():
            with written_whole(file) as partial:
                partial.write_text(json.dumps(asdict(self), indent=1))
        try:
            there = json.loads(file.read_bytes())
        except ValueError:
            there = None
        if there != asdict(self):
            raise DataError(
                f"{folder} does not hold the latents that its name promises, but those of {there}: "
                "delete the folder and encode again"
            )


class LatentClipDataset:
    """The windows that `acwm_core.data.encoding.encode_windows` encoded, with their actions.

    Args:
        episodes: the split they come from.
        fingerprint: the codec's, `Codec.fingerprint()`.
        frames: frames of a window, as encoded.
        stride: frames between windows, as encoded.
        indices: only these episodes, e.g. those of `hold_out`; all by default.
        skip_damaged: accept that damaged episodes were left out; only reading one raises.
        temporal_stride: the codec's, to cut clips of shorter episodes as `ClipDataset` does.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip, as in `ClipDataset`.
        lengths: video frames of each clip, as in `ClipDataset`.

    Raises:
        DataError: these windows have not been encoded by that codec, or the latents are damaged.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        fingerprint: str,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
        skip_damaged: bool = False,
        temporal_stride: int | None = None,
    ) -> None:
        folder = latent_folder(episodes, fingerprint, frames, stride)
        if unfinished(episodes, folder, skip_damaged):
            raise DataError(
                f"{episodes.split} of {episodes.path} is not encoded by the codec {fingerprint} in "
                f"windows of {frames} frames every {stride}{_encoded_by(episodes)}: encode it with "
                f"`acwm encode {episodes.path} --codec NAME --split {episodes.split} "
                f"--frames {frames} --stride {stride}`"
            )
        LatentsCard.of(episodes, fingerprint, frames, stride).keep(folder)
        self.frames = frames
        self.windows = list_windows(episodes.lengths, frames, stride, indices)
        self.lengths = clip_lengths(self.windows, episodes.lengths, frames, temporal_stride)
        self._temporal_stride = temporal_stride or 1
        self._files = _files(episodes, folder)
        self._counts = np.array([len(window_starts(n, frames, stride)) for n in episodes.lengths])
        self._places = _places(episodes, self._counts, stride, self.windows)
        self._rows = [
            int(self._counts[first : first + count].sum()) for first, count in episodes.shards
        ]
        self._maps: dict[int, NDArray[np.float16]] = {}
        self._damaged = self._left_out(episodes)
        self._read_actions(episodes, skip_damaged)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> LatentClip:
        """Read one clip.

        Raises:
            DamagedShardError: it was left out.
        """
        batch = self.batch([index])
        return {"latents": batch["latents"][0], "actions": batch["actions"][0]}

    def batch(self, indices: Sequence[int]) -> LatentClip:
        """Read clips of one length at once, ``[B, L, C, h, w]`` and ``[B, T, A]``.

        Raises:
            DamagedShardError: one of them was left out.
        """
        chosen = np.asarray(indices, np.int64)
        windows: list[tuple[int, int]] = self.windows[chosen].tolist()
        for episode, _ in windows:
            if episode in self._damaged:
                raise DamagedShardError(self._damaged[episode])
        frames = common_length(self.lengths, indices)
        # Of a window filled up with repeated frames, what comes before them is encoded as if alone.
        kept = None if frames == self.frames else 1 + (frames - 1) // self._temporal_stride
        latents = [self._map(shard)[place, :kept] for shard, place in self._places[chosen].tolist()]
        cut = [window_actions(self._actions[e], start, frames) for e, start in windows]
        actions = torch.as_tensor(np.stack(cut))
        return {"latents": torch.as_tensor(np.stack(latents)), "actions": actions}

    def __getstate__(self) -> dict[str, object]:
        """Without the open maps, which would travel as copies of their contents."""
        return {**self.__dict__, "_maps": {}}

    def _map(self, shard: int) -> NDArray[np.float16]:
        """The latents of a shard, mapped into memory."""
        if shard in self._maps:
            return self._maps[shard]
        file = self._files[shard]
        try:
            latents = np.load(file, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise _damaged_latents(file, str(error)) from error
        expected = self._map(0).shape[1:] if shard else latents.shape[1:]
        if latents.dtype != np.float16 or latents.shape != (self._rows[shard], *expected):
            raise _damaged_latents(file, f"they are {latents.dtype} {latents.shape}")
        # A plain view: indexing a memmap costs more than copying a small clip.
        self._maps[shard] = latents.view(np.ndarray)
        return self._maps[shard]

    def _left_out(self, episodes: EpisodeDataset) -> dict[int, str]:
        """Episodes without latents, and why."""
        found: dict[int, str] = {}
        for shard, file in enumerate(self._files):
            if not file.stem.endswith(".incomplete"):
                continue
            first, count = episodes.shards[shard]
            starts = np.concatenate([[0], np.cumsum(self._counts[first : first + count])])
            for place in range(count):
                if np.isnan(self._map(shard)[starts[place]].flat[0]):
                    path = episodes.shard_path(first + place)
                    found[first + place] = f"shard {path} was damaged when it was encoded"
        return found

    def _read_actions(self, episodes: EpisodeDataset, skip_damaged: bool) -> None:
        """Keep the actions of all chosen episodes."""
        self._actions: dict[int, NDArray[np.float32]] = {}
        for episode in map(int, np.unique(self.windows[:, 0])):
            try:
                self._actions[episode] = episodes.actions(episode)
            except DamagedShardError as error:
                if not skip_damaged:
                    raise
                self._damaged.setdefault(episode, str(error))


def _files(episodes: EpisodeDataset, folder: Path) -> list[Path]:
    """The file of each shard, the complete one if there is."""
    whole = [latent_file(folder, number) for number in range(len(episodes.shards))]
    return [
        file if file.exists() else incomplete_file(folder, number)
        for number, file in enumerate(whole)
    ]


def _places(
    episodes: EpisodeDataset, counts: NDArray[np.int64], stride: int, windows: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Rows ``(shard, row of its array)`` of `windows`."""
    before = np.concatenate([[0], np.cumsum(counts)])
    firsts = np.array([first for first, _ in episodes.shards])
    shards = np.searchsorted(firsts, windows[:, 0], side="right") - 1
    rows = before[windows[:, 0]] - before[firsts[shards]] + windows[:, 1] // stride
    return np.stack([shards, rows], 1)


def _damaged_latents(file: Path, reason: str) -> DataError:
    return DataError(f"the latents {file} are damaged ({reason}): delete the file and encode again")


def _encoded_by(episodes: EpisodeDataset) -> str:
    folder = episodes.path / LATENTS
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    return f" (there are latents of {', '.join(names)})" if names else ""
