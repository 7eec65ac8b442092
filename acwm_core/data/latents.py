"""Latents of clips: encoded once by a frozen codec, kept beside the clips, read at memory speed.

They lie in ``DATA/latents/<codec fingerprint>/<split>-<frames>x<stride>-<data checksum>/``, one
memory-mapped float16 array ``[clips, L, C, h, w]`` per shard. Another codec, other weights, other
windows or other data mean another folder, so that nothing is ever misread.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from acwm_core.codec import Codec
from acwm_core.data.atomic import held, remove_partial, written_whole
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.windows import list_windows, padded_video, window_actions, window_starts
from acwm_core.errors import DataError

LATENTS = "latents"


class LatentClip(TypedDict):
    """A clip: `latents` float32 ``[L, C, h, w]``, `actions` float32 ``[T, A]``, last row zero."""

    latents: Tensor
    actions: Tensor


def latent_folder(episodes: EpisodeDataset, fingerprint: str, frames: int, stride: int) -> Path:
    """Where the latents of these windows by the codec of that fingerprint are kept."""
    windows = f"{episodes.split}-{frames}x{stride}-{episodes.checksum[:12]}"
    return episodes.path / LATENTS / fingerprint / windows


def compresses(codec: Codec) -> bool:
    """Whether latents in float16 take less room than the 8-bit frames they stand for."""
    pixels = 3 * codec.spatial_stride**2 * codec.temporal_stride
    return 2 * codec.channels < pixels


def encode_windows(
    episodes: EpisodeDataset,
    codec: Codec,
    *,
    frames: int = 37,
    stride: int = 4,
    batch_size: int = 8,
    progress: bool = True,
) -> Path:
    """Encode every window of `episodes` that is not encoded yet.

    Shards that are finished are kept, so an interrupted call goes on where it ended.

    Args:
        episodes: the split to encode.
        codec: frozen; it is used in evaluation mode, on the device where its parameters are.
        frames: frames of a window.
        stride: frames between the starts of an episode's windows; 4 makes eight windows of 37
            frames of an episode of 66.
        batch_size: windows that are encoded at once.
        progress: show a progress bar on the terminal.

    Returns:
        The folder of the latents, which `LatentClipDataset` finds by the codec's fingerprint.

    Raises:
        DataError: the folder is in use or cannot be written, a shard is damaged, or the codec
            gave values that float16 cannot hold.
        ShapeError: the codec cannot encode frames of this size.
    """
    folder = latent_folder(episodes, codec.fingerprint(), frames, stride)
    if not _unfinished(episodes, folder):
        return folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with held(folder), _evaluating(codec), _progress_bar(episodes, progress) as report:
            remove_partial(folder)
            for number in _unfinished(episodes, folder):
                first, count = episodes.shards[number]
                encoded: list[NDArray[np.float16]] = []
                for index in range(first, first + count):
                    encoded.append(
                        _encode_episode(episodes, index, codec, frames, stride, batch_size)
                    )
                    report(1)
                with written_whole(_file(folder, number)) as partial, partial.open("wb") as file:
                    np.save(file, np.concatenate(encoded))
    except OSError as error:
        raise DataError(f"cannot write latents to {folder} ({error.strerror})") from error
    return folder


class LatentClipDataset(Dataset[LatentClip]):
    """The windows that `encode_windows` encoded, with their actions.

    Args:
        episodes: the split they come from.
        fingerprint: the codec's, `Codec.fingerprint()`.
        frames: frames of a window, as encoded.
        stride: frames between windows, as encoded.
        indices: only these episodes, e.g. those of `hold_out`; all by default.

    Attributes:
        windows: rows ``(episode, first frame)``, one per clip, as in `ClipDataset`.

    Raises:
        DataError: these windows have not been encoded by that codec.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        fingerprint: str,
        *,
        frames: int = 37,
        stride: int = 4,
        indices: Sequence[int] | None = None,
    ) -> None:
        folder = latent_folder(episodes, fingerprint, frames, stride)
        if _unfinished(episodes, folder):
            raise DataError(
                f"{episodes.split} of {episodes.path} is not encoded by the codec {fingerprint} in "
                f"windows of {frames} frames every {stride}{_encoded_by(episodes)}: encode it "
                "with acwm_core.data.latents.encode_windows"
            )
        self.frames = frames
        self.windows = list_windows(episodes.lengths, frames, stride, indices)
        self._files = [_file(folder, number) for number in range(len(episodes.shards))]
        self._places = _places(episodes, frames, stride, self.windows)
        self._actions = {int(e): episodes.actions(int(e)) for e in np.unique(self.windows[:, 0])}
        self._maps: dict[int, NDArray[np.float16]] = {}

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> LatentClip:
        """Read one clip."""
        shard, place = map(int, self._places[index])
        episode, start = map(int, self.windows[index])
        if shard not in self._maps:
            self._maps[shard] = np.load(self._files[shard], mmap_mode="r")
        latents = self._maps[shard][place].astype(np.float32)
        actions = window_actions(self._actions[episode], start, self.frames)
        return {"latents": torch.as_tensor(latents), "actions": torch.as_tensor(actions)}

    def __getstate__(self) -> dict[str, object]:
        """Without the open maps, which would travel as copies of their contents."""
        return {**self.__dict__, "_maps": {}}


def _encode_episode(
    episodes: EpisodeDataset, index: int, codec: Codec, frames: int, stride: int, batch_size: int
) -> NDArray[np.float16]:
    """All windows of one episode, ``[clips, L, C, h, w]``."""
    device = next((p.device for p in codec.parameters()), torch.device("cpu"))
    pixels = padded_video(episodes.video(index), frames)
    video = torch.as_tensor(pixels).to(device).float() / 255
    starts = window_starts(episodes.lengths[index], frames, stride)
    whole_groups = stride % codec.temporal_stride == 0 and (frames - 1) % codec.temporal_stride == 0
    with torch.inference_mode():
        if codec.memoryless and whole_groups:
            latents = _encode_shared(codec, video, starts, frames)
        else:
            clips = [video[start : start + frames] for start in starts]
            latents = torch.cat(
                [
                    codec.encode(torch.stack(clips[at : at + batch_size]))
                    for at in range(0, len(clips), batch_size)
                ]
            )
    with np.errstate(over="ignore"):  # refused below
        values = latents.float().cpu().numpy().astype(np.float16)
    if not np.isfinite(values).all():
        raise DataError(
            f"{type(codec).__name__} encodes episode {index} of {episodes.split} of "
            f"{episodes.path} to values that are not finite or too large for float16"
        )
    return values


def _encode_shared(codec: Codec, video: Tensor, starts: range, frames: int) -> Tensor:
    """Windows of a memoryless codec: only their first frames differ from the whole's latents."""
    firsts = codec.encode(video[list(starts)].unsqueeze(1))
    whole = codec.encode(video.unsqueeze(0))[0]
    following = codec.latent_frames(frames) - 1
    places = [start // codec.temporal_stride + 1 for start in starts]
    return torch.stack(
        [
            torch.cat([first, whole[place : place + following]])
            for first, place in zip(firsts, places, strict=True)
        ]
    )


def _places(
    episodes: EpisodeDataset, frames: int, stride: int, windows: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Rows ``(shard, row of its array)`` of `windows`."""
    counts = [len(window_starts(length, frames, stride)) for length in episodes.lengths]
    before = np.concatenate([[0], np.cumsum(counts)])
    firsts = np.array([first for first, _ in episodes.shards])
    shards = np.searchsorted(firsts, windows[:, 0], side="right") - 1
    rows = before[windows[:, 0]] - before[firsts[shards]] + windows[:, 1] // stride
    return np.stack([shards, rows], 1)


def _unfinished(episodes: EpisodeDataset, folder: Path) -> list[int]:
    return [n for n in range(len(episodes.shards)) if not _file(folder, n).exists()]


def _file(folder: Path, number: int) -> Path:
    return folder / f"shard-{number:05d}.npy"


def _encoded_by(episodes: EpisodeDataset) -> str:
    folder = episodes.path / LATENTS
    names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    return f" (there are latents of {', '.join(names)})" if names else ""


@contextlib.contextmanager
def _evaluating(codec: Codec) -> Generator[None]:
    """Evaluation mode for the block."""
    training = codec.training
    codec.eval()
    try:
        yield
    finally:
        codec.train(training)


@contextlib.contextmanager
def _progress_bar(episodes: EpisodeDataset, shown: bool) -> Generator[Callable[[int], None]]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not shown) as bar:
        task = bar.add_task(f"encoding {episodes.split}", total=len(episodes))
        yield lambda count: bar.advance(task, count)
