"""Encoding the clips of a dataset: every window once, by any number of processes together.

Each shard of latents is made under a lock of its own, so that the ranks of a training, or several
`acwm encode` on machines that share the folder, divide the shards among themselves and none of
them waits in a collective, which would time out. A shard appears only when it is whole.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.codec import Codec
from acwm_core.data.atomic import alone, written_whole
from acwm_core.data.clips import padded_video, window_starts
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.latents import (
    LatentsCard,
    incomplete_file,
    latent_file,
    latent_folder,
    unfinished,
)
from acwm_core.errors import DamagedShardError, DataError

Report = Callable[[int], None]


def encode_windows(
    episodes: EpisodeDataset,
    codec: Codec,
    *,
    frames: int = 37,
    stride: int = 4,
    batch_size: int = 8,
    skip_damaged: bool = False,
    progress: bool = True,
) -> Path:
    """Encode every window of `episodes` that is not encoded yet.

    Shards that are finished are kept, so an interrupted call resumes where it ended. Processes that
    call this at once share the work, and each returns when all of it is done.

    Args:
        episodes: the split to encode.
        codec: frozen; it is used in evaluation mode, on the device where its parameters are.
        frames: frames of a window.
        stride: frames between the starts of an episode's windows; 4 makes eight windows of 37
            frames of an episode of 66.
        batch_size: windows that are encoded at once.
        skip_damaged: leave out episodes whose shard is damaged instead of raising; a later call
            without this encodes them, once the shard is fixed.
        progress: show a progress bar on the terminal.

    Returns:
        The folder of the latents, which `LatentClipDataset` finds by the codec's fingerprint.

    Raises:
        DamagedShardError: a shard is damaged.
        DataError: the folder cannot be written or holds latents of another codec, or the codec gave
            values that float16 cannot hold.
        ShapeError: the codec cannot encode frames of this size.
    """
    folder = latent_folder(episodes, codec.fingerprint(), frames, stride)
    work = _Work(episodes, codec, frames, stride, batch_size, skip_damaged)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        LatentsCard.of(episodes, codec.fingerprint(), frames, stride).keep(folder)
        missing = unfinished(episodes, folder, skip_damaged)
        total = sum(episodes.shards[number][1] for number in missing)
        with _evaluating(codec), _progress_bar(episodes.split, total, progress) as report:
            # First what nobody else is at; then what others do not finish.
            for wait in (False, True):
                for number in unfinished(episodes, folder, skip_damaged):
                    with alone(latent_file(folder, number), wait=wait) as mine:
                        if mine and number in unfinished(episodes, folder, skip_damaged):
                            _write_shard(work, folder, number, report)
    except OSError as error:
        raise DataError(f"cannot write latents to {folder} ({error.strerror})") from error
    return folder


@dataclass(frozen=True)
class _Work:
    """What `encode_windows` was asked to do."""

    episodes: EpisodeDataset
    codec: Codec
    frames: int
    stride: int
    batch_size: int
    skip_damaged: bool


def _write_shard(work: _Work, folder: Path, number: int, report: Report) -> None:
    """Encode the windows of one shard; those of damaged episodes stay NaN, which is no latent."""
    first, count = work.episodes.shards[number]
    encoded: list[NDArray[np.float16] | None] = []
    for index in range(first, first + count):
        try:
            encoded.append(_encode_episode(work, index))
        except DamagedShardError:
            if not work.skip_damaged:
                raise
            encoded.append(None)
        report(1)
    complete = all(each is not None for each in encoded)
    file = latent_file(folder, number) if complete else incomplete_file(folder, number)
    rows = [
        _nothing(work, first + place) if each is None else each
        for place, each in enumerate(encoded)
    ]
    with written_whole(file) as partial, partial.open("wb") as opened:
        np.save(opened, np.concatenate(rows))
    if complete:
        incomplete_file(folder, number).unlink(missing_ok=True)


def _nothing(work: _Work, index: int) -> NDArray[np.float16]:
    """NaN in the place of an episode's latents."""
    codec, episodes = work.codec, work.episodes
    windows = len(window_starts(episodes.lengths[index], work.frames, work.stride))
    size = codec.latent_size(*episodes.card.environment.frame_size)
    shape = (windows, codec.latent_frames(work.frames), codec.channels, *size)
    return np.full(shape, np.nan, np.float16)


def _encode_episode(work: _Work, index: int) -> NDArray[np.float16]:
    """All windows of one episode, ``[clips, L, C, h, w]``."""
    codec, frames, stride = work.codec, work.frames, work.stride
    device = next((p.device for p in codec.parameters()), torch.device("cpu"))
    pixels = padded_video(work.episodes.video(index), frames)
    video = torch.as_tensor(pixels).to(device).float() / 255
    starts = window_starts(work.episodes.lengths[index], frames, stride)
    whole_groups = stride % codec.temporal_stride == 0 and (frames - 1) % codec.temporal_stride == 0
    with torch.inference_mode():
        if codec.memoryless and whole_groups:
            latents = _encode_shared(codec, video, starts, frames)
        else:
            clips = [video[start : start + frames] for start in starts]
            latents = torch.cat(
                [
                    codec.encode(torch.stack(clips[at : at + work.batch_size]))
                    for at in range(0, len(clips), work.batch_size)
                ]
            )
    with np.errstate(over="ignore"):  # refused below
        values = latents.float().cpu().numpy().astype(np.float16)
    if not np.isfinite(values).all():
        raise DataError(
            f"{type(codec).__name__} encodes episode {index} of {work.episodes.split} of "
            f"{work.episodes.path} to values that are not finite or too large for float16"
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
def _progress_bar(split: str, total: int, shown: bool) -> Generator[Report]:
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not shown or not total) as bar:
        task = bar.add_task(f"encoding {split}", total=total)
        yield lambda count: bar.advance(task, count)
