"""Random groups of four consecutive frames, from which the codecs `Compact` and `Fine` learn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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

Videos = list[NDArray[np.uint8]]
"""Videos `[T, H, W, 3]`, 0-255."""


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


def random_group(videos: Videos, rng: np.random.Generator) -> NDArray[np.uint8]:
    """One augmented group of four frames, folded to `[12, 64, 64]`."""
    video = videos[int(rng.integers(len(videos)))]
    time_steps, height, width, _ = video.shape
    start = int(rng.integers(time_steps - STRIDE + 1))
    frames = [start] * STRIDE if rng.random() < STILL_FRACTION else range(start, start + STRIDE)
    y, x = int(rng.integers(height - CROP + 1)), int(rng.integers(width - CROP + 1))
    group = video[list(frames), y : y + CROP, x : x + CROP]
    if rng.random() < STRANGE_FRACTION:
        group = group[:, :: rng.choice([-1, 1]), :: rng.choice([-1, 1]), rng.permutation(3)]
    return np.ascontiguousarray(group.transpose(0, 3, 1, 2).reshape(-1, CROP, CROP))


def sample_groups(
    sources: Sequence[Videos], count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Groups `[count, 12, 64, 64]` in [0, 1] from random sources, and their sources `[count]`."""
    chosen = rng.integers(len(sources), size=count)
    groups = np.stack([random_group(sources[source], rng) for source in chosen])
    batch = torch.from_numpy(groups).float() / 255
    return batch.contiguous(memory_format=torch.channels_last), torch.from_numpy(chosen)
