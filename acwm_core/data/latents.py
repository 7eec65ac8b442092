"""Latents of clips: encoded once by a frozen codec, kept beside the clips, read at memory speed.

They lie in ``DATA/latents/<codec fingerprint>/<split>-<frames>x<stride>-<data checksum>/``, one
float16 array ``[clips, L, C, h, w]`` per shard; those of a dataset that cannot be written to lie in
the user's cache. Latents of transformed clips are in a folder of
their own, whose name ends with the symmetry's: to transform latents would not be exact. A card in
each folder repeats these facts, so that a renamed or copied folder is not misread.

Any number of processes encode a dataset together: each shard of latents has its own lock, because
waiting in a collective operation would time out.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import re
import shlex
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.clips import Clips, padded_video, window_starts
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import AcwmWarning, DataError, noting
from acwm_core.executors import Report, progress_bar
from acwm_core.files import (
    CACHE as CACHE_VARIABLE,
)
from acwm_core.files import (
    alone,
    cache_folder,
    is_writable,
    parse_json,
    writing,
    written_whole,
)
from acwm_core.model.codec import Codec
from acwm_core.model.precision import bfloat16_is_fast

LATENTS = "latents"
CARD = "latents.json"


def compresses(codec: Codec) -> bool:
    """Whether float16 latents take less space than the 8-bit frames they encode."""
    return 2 * codec.channels < 3 * codec.spatial_stride**2 * codec.temporal_stride


def shard_name(number: int) -> str:
    """The name of the file with the latents of a shard."""
    return f"shard-{number:05d}.npy"


@dataclass(frozen=True)
class LatentFolder:
    """The folder of the latents of a split's windows, with one file per shard."""

    episodes: EpisodeDataset  # the split
    fingerprint: str  # `Codec.latents_fingerprint()`
    frames: int  # frames of a window
    stride: int  # frames between the starts of an episode's windows
    symmetry: Symmetry | None = None  # transforms the windows before they are encoded

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w[\w.-]*", str(self.fingerprint)):
            raise DataError(f"the codec has the fingerprint {self.fingerprint!r}, not a valid name")

    @functools.cached_property
    def path(self) -> Path:
        """The folder: beside the clips, or in the user's cache if nothing can be written there."""
        episodes = self.episodes
        windows = f"{episodes.split}-{self.frames}x{self.stride}-{episodes.checksum[:12]}"
        windows += f"-{self.symmetry.name}" if self.symmetry else ""
        name = Path(LATENTS, str(self.fingerprint), windows)
        beside = episodes.path / name
        shards = range(len(episodes.shards))
        if is_writable(beside) or all((beside / shard_name(shard)).exists() for shard in shards):
            return beside
        return cache_folder() / name

    def file(self, number: int) -> Path:
        """The file of shard `number`."""
        return self.path / shard_name(number)

    def unfinished(self) -> list[int]:
        """Shards without latents."""
        numbers = range(len(self.episodes.shards))
        return [number for number in numbers if not self.file(number).exists()]

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
        card |= {"symmetry": self.symmetry.name} if self.symmetry else {}
        if not file.exists():
            with written_whole(file) as partial:
                partial.write_text(json.dumps(card, indent=1), "utf-8")
        try:
            there = parse_json(file.read_bytes())
        except ValueError:
            there = None
        if there != card:
            raise DataError(
                f"{self.path} holds other latents than its name says, those of {there}: delete the "
                "folder and encode again"
            )


def encode_windows(
    episodes: EpisodeDataset,
    codec: Codec,
    *,
    frames: int = 37,
    stride: int = 4,
    batch_size: int = 8,
    symmetry: Symmetry | None = None,
    progress: bool = True,
) -> Path:
    """Encode every window of `episodes` that is not encoded yet.

    Finished shards are kept, so an interrupted call can be resumed. Processes that call this at the
    same time share the work, and each returns when all of it is done.

    Args:
        episodes: the split to encode.
        codec: frozen; used in evaluation mode, on the device of its parameters.
        stride: frames between the starts of an episode's windows; 4 gives eight windows of 37
            frames for an episode of 66.
        symmetry: transforms the windows before they are encoded.

    Returns:
        The folder of the latents, which `LatentClipDataset` finds by the codec's fingerprint.

    Raises:
        DataError: a shard is damaged; the folder cannot be written or holds latents of another
            codec; or the codec returned values that float16 cannot hold.
        ShapeError: the codec cannot encode frames of this size.
    """
    folder = LatentFolder(episodes, codec.latents_fingerprint(), frames, stride, symmetry)
    if progress and not folder.path.is_relative_to(episodes.path):
        warnings.warn(
            f"{episodes.path} cannot be written to, so its latents are kept in {folder.path} (set "
            f"{CACHE_VARIABLE} for another place, or data.cache_latents=false to keep none)",
            AcwmWarning,
            stacklevel=2,
        )
    instead = "or train without them, with data.cache_latents=false"
    with writing(folder.path, instead), contextlib.ExitStack() as stack:
        folder.path.mkdir(parents=True, exist_ok=True)
        folder.keep_card()
        total = sum(episodes.shards[number][1] for number in folder.unfinished())
        what = f"encoding {episodes.split}" + (f" {symmetry.name}" if symmetry else "")
        bar = progress_bar(what, total, shown=progress)
        report = stack.enter_context(bar)
        stack.callback(codec.train, codec.training)
        codec.eval()
        # First the shards that no other process works on, then those that others did not finish.
        for wait in (False, True):
            for number in folder.unfinished():
                with alone(folder.file(number), wait=wait) as mine:
                    if mine and not folder.file(number).exists():
                        _encode_shard(folder, codec, number, batch_size, report)
    return folder.path


def _encode_shard(
    folder: LatentFolder, codec: Codec, number: int, batch_size: int, report: Report
) -> None:
    rows = list[NDArray[np.float16]]()
    first, count = folder.episodes.shards[number]
    for index in range(first, first + count):
        with noting(f"in episode {index} of {folder.episodes.split}", codec):
            rows.append(_encode_episode(folder, codec, index, batch_size))
        report(1)
    with written_whole(folder.file(number)) as partial, partial.open("wb") as opened:
        np.save(opened, np.concatenate(rows))


def _encode_episode(
    folder: LatentFolder, codec: Codec, index: int, batch_size: int
) -> NDArray[np.float16]:
    """The latents of the windows of an episode, ``[windows, L, C, h, w]``."""
    frames, group, starts = folder.frames, codec.temporal_stride, folder.starts(index)
    device = next((p.device for p in codec.parameters()), torch.device("cpu"))
    pixels = padded_video(folder.episodes.video(index), frames)
    if folder.symmetry:
        pixels = folder.symmetry.of_frames(pixels).copy()
    video = torch.as_tensor(pixels).to(device).float() / 255
    fast = codec.encodes_in_bfloat16 and device.type == "cpu" and bfloat16_is_fast()
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=fast):
        if codec.memoryless and folder.stride % group == 0 and (frames - 1) % group == 0:
            latents = _encode_shared(codec, video, starts, frames)
        else:
            clips = torch.stack([video[start : start + frames] for start in starts])
            latents = torch.cat([codec.encode(batch) for batch in torch.split(clips, batch_size)])
    with np.errstate(over="ignore"):  # refused below
        values = latents.float().cpu().numpy().astype(np.float16)
    if not np.isfinite(values).all():
        raise DataError(
            f"{type(codec).__name__} encodes episode {index} of {folder.episodes.split} of "
            f"{folder.episodes.path} to values that are not finite or too large for float16"
        )
    return values


def _encode_shared(codec: Codec, video: Tensor, starts: range, frames: int) -> Tensor:
    """Encode the windows of a memoryless codec from one encoding of the whole episode.

    Only the first latent frame of each window differs from the latents of the whole episode.
    """
    firsts = codec.encode(video[list(starts)].unsqueeze(1))
    whole = codec.encode(video.unsqueeze(0))[0]
    places = torch.tensor(starts) // codec.temporal_stride + 1
    following = torch.arange(codec.latent_frames(frames) - 1)
    return torch.cat([firsts, whole[places[:, None] + following]], 1)


class LatentClipDataset(Clips):
    """The latents that `encode_windows` wrote: ``latents`` float16 ``[B, L, C, h, w]``.

    Args:
        episodes: the split they come from.
        fingerprint: `Codec.latents_fingerprint()`.
        temporal_stride: as in `Clips`.
        windows: `frames` and `stride`, as they were encoded, and `indices`, `given`, `per_length`,
            `symmetries` and `states`, as in `Clips`.

    Raises:
        DataError: these windows have not been encoded by that codec, or a shard is damaged.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        fingerprint: str,
        *,
        temporal_stride: int | None = None,
        **windows: Any,
    ) -> None:
        super().__init__(episodes, temporal_stride=temporal_stride, **windows)
        self._folders = [
            LatentFolder(episodes, fingerprint, self.frames, self.stride, symmetry)
            for symmetry in self.versions
        ]
        for folder in self._folders:
            if folder.unfinished():
                raise _not_encoded(folder)
            folder.keep_card()
        self._temporal_stride = temporal_stride or 1
        counts = [len(self._folders[0].starts(index)) for index in range(len(episodes))]
        # For every episode: its shard, and the row of its first window in the shard's array.
        self._places = [
            (number, sum(counts[first:index]))
            for number, (first, count) in enumerate(episodes.shards)
            for index in range(first, first + count)
        ]
        self._rows = [sum(counts[first : first + count]) for first, count in episodes.shards]
        self._layouts: dict[Path, tuple[int, tuple[int, ...]]] = {}
        for episode in map(int, np.unique(self.windows[:, 0])):
            self._remember(episode)

    def _frames(self, indices: Sequence[int], frames: int) -> dict[str, Tensor]:
        # In a window padded with repeated frames, latents before the padding do not depend on it.
        kept = None if frames == self.frames else 1 + (frames - 1) // self._temporal_stride
        latents = list[NDArray[np.float16]]()
        windows: list[tuple[int, int]] = self.windows[list(indices)].tolist()
        for index, (episode, start) in zip(indices, windows, strict=True):
            folder = self._folders[index % len(self._folders)]
            shard, row = self._places[episode]
            latents.append(self._window(folder, shard, row + start // self.stride, kept))
        return {"latents": torch.as_tensor(np.stack(latents))}

    def _window(
        self, folder: LatentFolder, shard: int, row: int, kept: int | None
    ) -> NDArray[np.float16]:
        """A window's latents, or the first `kept` of them, `[L, C, h, w]`.

        They are read, not memory-mapped: accessing the map of a truncated file would kill the
        process with SIGBUS.
        """
        file = folder.file(shard)
        try:
            offset, shape = self._layout(shard, file)
            latents = np.empty((kept or shape[0], *shape[1:]), np.float16)
            place = offset + row * math.prod(shape) * latents.itemsize
            with file.open("rb", buffering=0) as opened:
                if os.preadv(opened.fileno(), [latents.data], place) != latents.nbytes:
                    raise ValueError("its end is cut off")
        except (ValueError, EOFError, OSError) as error:
            raise DataError(
                f"the latents {file} are damaged ({error}): delete the file and encode again"
            ) from error
        return latents

    def _layout(self, shard: int, file: Path) -> tuple[int, tuple[int, ...]]:
        """The byte offset of a shard's latents in its file, and the shape of one window's."""
        if file not in self._layouts:
            latents = np.load(file, mmap_mode="r", allow_pickle=False)
            if latents.dtype != np.float16 or len(latents) != self._rows[shard]:
                raise ValueError(f"they are {latents.dtype} {latents.shape}")
            self._layouts[file] = int(latents.offset), latents.shape[1:]
        return self._layouts[file]


def _not_encoded(folder: LatentFolder) -> DataError:
    episodes, symmetry = folder.episodes, folder.symmetry
    others = sorted(path.name for path in (episodes.path / LATENTS).glob("*"))
    known = f" (there are latents of {', '.join(others)})" if others else ""
    return DataError(
        f"{episodes.split} of {episodes.path} is not encoded by the codec {folder.fingerprint} in "
        f"windows of {folder.frames} frames every {folder.stride}"
        f"{f', {symmetry.name}' if symmetry else ''}{known}: encode it with "
        f"`acwm encode {shlex.quote(str(episodes.path))} --codec NAME --split {episodes.split} "
        f"--frames {folder.frames} --stride {folder.stride}{' --symmetries' if symmetry else ''}`"
    )
