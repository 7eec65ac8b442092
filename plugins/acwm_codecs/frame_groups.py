"""Random groups of four consecutive frames, from which codecs learn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_codecs.compact import STRIDE
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError

CROP = 64
STILL_FRACTION = 0.15  # groups that repeat one frame, as the first latent frame does
STRANGE_FRACTION = 0.25  # groups that are mirrored and have permuted colours

PREDICTED_FRACTION = 0.7  # groups whose latents are a model's, if there is a model

Videos = list[NDArray[np.uint8]]
"""Videos `[T, H, W, 3]`, 0-255."""


@dataclass(frozen=True)
class Source:
    """The videos of a dataset.

    Attributes:
        videos: see `Videos`.
        predicted: what a model predicts of each from its first frame, latents `[L, C, h, w]`; empty
            without a model.
    """

    videos: Videos
    predicted: list[NDArray[np.float16]] = field(default_factory=list[NDArray[np.float16]])


class FrameGroup(NamedTuple):
    """Four frames of a video, `[12, 64, 64]`, and what they are decoded from.

    Attributes:
        frames: the frames, folded.
        reference: a frame before them, `[3, 64, 64]`.
        latents: what a model predicts, `[C, h, w]`; None for the codec's own.
    """

    frames: NDArray[np.uint8]
    reference: NDArray[np.uint8]
    latents: NDArray[np.float16] | None = None


class Groups(NamedTuple):
    """A batch of N groups.

    Attributes:
        frames: `[N, 12, 64, 64]` in [0, 1].
        references: `[N, 3, 64, 64]` in [0, 1].
        predicted: which groups have predicted latents, `[N]`.
        latents: these latents, `[M, C, h, w]`.
        sources: number of the source of each group, `[N]`.
    """

    frames: Tensor
    references: Tensor
    predicted: Tensor
    latents: Tensor
    sources: Tensor


def load_videos(folder: Path, most: int) -> Videos:
    """Up to `most` training videos `[T, H, W, 3]` of a dataset, decoded into memory.

    Raises:
        DataError: there are none, or a frame is too small for a crop, or an episode too short.
    """
    episodes = EpisodeDataset(folder, "train")
    height, width = episodes.card.environment.frame_size
    if min(height, width) < CROP:
        raise DataError(
            f"frames of {folder} are {height}×{width}, and training needs {CROP}×{CROP}"
        )
    if min(episodes.lengths[:most]) < STRIDE:
        raise DataError(f"{folder} has an episode of less than the {STRIDE} frames of a latent one")
    videos = (episodes.video(index) for index in range(min(most, len(episodes))))
    return [np.ascontiguousarray(video.transpose(0, 2, 3, 1)) for video in videos]


def random_group(source: Source, rng: np.random.Generator) -> FrameGroup:
    """One group; an augmented one, if its latents are to be the codec's own."""
    index = int(rng.integers(len(source.videos)))
    video = source.videos[index]
    if source.predicted and rng.random() < PREDICTED_FRACTION:
        return _predicted_group(video, source.predicted[index], rng)
    time_steps, height, width, _ = video.shape
    start = int(rng.integers(time_steps - STRIDE + 1))
    frames = [start] * STRIDE if rng.random() < STILL_FRACTION else range(start, start + STRIDE)
    y, x = int(rng.integers(height - CROP + 1)), int(rng.integers(width - CROP + 1))
    shown = video[:, y : y + CROP, x : x + CROP]
    if rng.random() < STRANGE_FRACTION:
        shown = shown[:, :: rng.choice([-1, 1]), :: rng.choice([-1, 1]), rng.permutation(3)]
    before = int(rng.integers(start + 1))
    return FrameGroup(_folded(shown[list(frames)]), _folded(shown[before : before + 1]))


def _predicted_group(
    video: NDArray[np.uint8], latents: NDArray[np.float16], rng: np.random.Generator
) -> FrameGroup:
    """A group with the latents that a model predicts of it from the video's first frame."""
    height, width = video.shape[1:3]
    stride, frame = height // latents.shape[2], int(rng.integers(1, len(latents)))
    y, x = (int(rng.integers((side - CROP) // stride + 1)) for side in (height, width))
    cells = CROP // stride
    top, left = y * stride, x * stride
    shown = video[:, top : top + CROP, left : left + CROP]
    first = 1 + STRIDE * (frame - 1)
    return FrameGroup(
        _folded(shown[first : first + STRIDE]),
        _folded(shown[:1]),
        latents[frame, :, y : y + cells, x : x + cells],
    )


def _folded(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Frames `[n, 64, 64, 3]` as channels, `[3n, 64, 64]`."""
    return np.ascontiguousarray(frames.transpose(0, 3, 1, 2).reshape(-1, CROP, CROP))


def sample_groups(sources: Sequence[Source], count: int, rng: np.random.Generator) -> Groups:
    """Groups of random sources."""
    chosen = rng.integers(len(sources), size=count)
    drawn = [random_group(sources[source], rng) for source in chosen]
    latents = [each.latents for each in drawn if each.latents is not None]
    return Groups(
        _pixels([each.frames for each in drawn]),
        _pixels([each.reference for each in drawn]),
        torch.tensor([each.latents is not None for each in drawn]),
        torch.from_numpy(np.stack(latents)).float() if latents else torch.empty(0),
        torch.from_numpy(chosen),
    )


def _pixels(pictures: Sequence[NDArray[np.uint8]]) -> Tensor:
    batch = torch.from_numpy(np.stack(pictures)).float() / 255
    return batch.contiguous(memory_format=torch.channels_last)
