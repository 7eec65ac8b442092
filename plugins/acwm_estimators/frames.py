"""Training frames in memory, with masks and targets, and their augmentation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Episode
from acwm_estimators.layout import Layout
from acwm_estimators.targets import targets_of

MIN_SHARE = 0.65
"""Smallest share of the frame itself when it is blended with a neighbour."""


@dataclass(frozen=True)
class LabelledFrames:
    """Frames of one size.

    Attributes:
        video: frames, `[F, H, W, 3]` uint8.
        neighbours: index of the next or previous frame of the same episode, `[F]`.
        masks: the layout's classes, `[F, H, W]` uint8.
        targets: targets by name, `[F, …]`; see `acwm_estimators.targets`.
    """

    video: NDArray[np.uint8]
    neighbours: NDArray[np.int64]
    masks: NDArray[np.uint8]
    targets: dict[str, NDArray[np.float32]]


def load_frames(folder: Path, layout: Layout, most: int) -> LabelledFrames:
    """Load the frames of up to `most` training episodes of a dataset.

    Raises:
        DataError: the folder is not a dataset, or has no training split.
    """
    dataset = EpisodeDataset(folder, "train")
    card = dataset.card.environment
    classes = classes_of(card.instances, layout)
    parts: list[LabelledFrames] = []
    for index in range(min(most, len(dataset))):
        episode: Episode = dataset[index]
        targets = targets_of(episode.states, episode.masks, layout, card)
        frames = len(episode.video)
        neighbours = np.append(np.arange(1, frames), frames - 2)
        parts.append(LabelledFrames(episode.video, neighbours, classes[episode.masks], targets))
    return joined(parts)


def joined(parts: Sequence[LabelledFrames]) -> LabelledFrames:
    """Concatenate frames."""
    starts = np.cumsum([0, *(len(part.video) for part in parts[:-1])])
    return LabelledFrames(
        np.concatenate([part.video for part in parts]),
        np.concatenate([part.neighbours + s for part, s in zip(parts, starts, strict=True)]),
        np.concatenate([part.masks for part in parts]),
        {name: np.concatenate([part.targets[name] for part in parts]) for name in parts[0].targets},
    )


def classes_of(instances: Sequence[str], layout: Layout) -> NDArray[np.uint8]:
    """The layout's class for each id of the card; 0 for the background and all that is not read."""
    classes = np.zeros(256, np.uint8)
    for number, name in enumerate(layout.instances, start=1):
        classes[instances.index(name)] = number
    return classes


def reconstructed(frames: LabelledFrames, codec: Any, clips: int, length: int) -> LabelledFrames:
    """Reconstructions of evenly spaced clips by a codec, with the same masks and targets.

    Args:
        frames: frames of one dataset.
        codec: an `acwm_core.model.codec.Codec`.
        clips: number of clips.
        length: frames per clip, ``1 + 4k``.
    """
    starts = np.linspace(0, len(frames.video) - length, clips).astype(int)
    chosen = np.concatenate([np.arange(start, start + length) for start in starts])
    videos: list[NDArray[np.uint8]] = []
    with torch.no_grad():
        for start in starts:
            clip = as_video(frames.video[start : start + length])
            seen = codec(clip[None])[0].clamp(0, 1).mul(255).round().byte()
            videos.append(seen.permute(0, 2, 3, 1).numpy())
    step = np.tile(np.append(np.arange(1, length), length - 2), clips)
    return LabelledFrames(
        np.concatenate(videos),
        step + np.repeat(np.arange(clips) * length, length),
        frames.masks[chosen],
        {name: values[chosen] for name, values in frames.targets.items()},
    )


def as_video(frames: NDArray[np.uint8]) -> Tensor:
    """Convert frames `[N, H, W, 3]` uint8 to `[N, 3, H, W]` in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255


def draw(
    frames: LabelledFrames, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Draw a batch of augmented frames `[N, 3, H, W]`, their classes `[N, H, W]` and targets."""
    chosen = rng.integers(len(frames.video), size=count)
    video = spoiled(
        as_video(frames.video[chosen]), as_video(frames.video[frames.neighbours[chosen]]), rng
    )
    targets = {name: torch.from_numpy(values[chosen]) for name, values in frames.targets.items()}
    return video, torch.from_numpy(frames.masks[chosen]).long(), targets


def spoiled(video: Tensor, neighbours: Tensor, rng: np.random.Generator) -> Tensor:
    """Degrade frames like predictions: blended with a neighbour, blurred, wrong colours, noisy.

    A third of the frames stays as it is; each other frame gets each fault with an even chance.
    """
    count, height, width = len(video), *video.shape[-2:]
    hit = torch.from_numpy(rng.random((4, count, 1, 1, 1)) * (rng.random((count, 1, 1, 1)) > 0.35))
    hit = (hit > 0.5).float()
    share = torch.from_numpy(rng.uniform(0, 1 - MIN_SHARE, (count, 1, 1, 1))).float() * hit[0]
    video = video + share * (neighbours - video)
    scale = rng.uniform(0.4, 0.9)
    small = functional.interpolate(
        video, (round(height * scale), round(width * scale)), mode="bilinear", antialias=True
    )
    blurred = functional.interpolate(small, (height, width), mode="bilinear")
    video = video + hit[1] * (blurred - video)
    gain = torch.from_numpy(rng.uniform(0.9, 1.1, (count, 3, 1, 1))).float()
    shift = torch.from_numpy(rng.uniform(-0.05, 0.05, (count, 1, 1, 1))).float()
    video = video + hit[2] * (video * (gain - 1) + shift)
    amount = torch.from_numpy(rng.uniform(0, 0.06, (count, 1, 1, 1))).float() * hit[3]
    noise = torch.from_numpy(rng.standard_normal(video.shape, np.float32))
    return (video + amount * noise).clamp(0, 1)
