"""Which clips are predicted: test episodes from their first frame, or the published windows."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acwm_core.episode import SPLITS
from acwm_core.errors import DataError
from acwm_core.evaluation.config import EvaluationConfig

TRAJECTORY_SEED = 0
"""Of the draw of episodes under `acwm-phys`, as published, whatever `evaluation.seed` is."""


@dataclass(frozen=True)
class ClipPlan:
    """One clip to predict, decided before any video is read.

    Split, episode and start are its identity.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame that is the clip's first, which the model is given.
        frames: length of the clip.
        donor: the other episode, whose actions the ``shuffled`` row is given.
        donor_start: the donor's frame from which on they are taken.
        seed: of the sampling noise; depends on split, episode and start alone.
        floor: whether states are read of the true video and of the codec's reconstruction too.
    """

    split: str
    episode: int
    start: int
    frames: int
    donor: int
    donor_start: int
    seed: int
    floor: bool = True


def plan_clips(split: str, lengths: Sequence[int], config: EvaluationConfig) -> list[ClipPlan]:
    """The clips of a split, in order of episode and start.

    Args:
        split: test split.
        lengths: frames of each of its episodes.
        config: decides which clips are taken, and the seeds.

    Raises:
        DataError: fewer than two episodes, so that there is no other's actions to take.
    """
    chosen = choose_episodes(len(lengths), config)
    if len(chosen) < 2:
        raise DataError(
            f"{split} has {len(chosen)} episode(s), and evaluation needs two, to predict one with "
            "the actions of another: generate more"
        )
    order = derangement(len(chosen), config.seed)
    return [
        ClipPlan(
            split,
            episode,
            start,
            frames,
            donor=donor,
            donor_start=max(0, min(start, lengths[donor] - frames)),
            seed=noise_seed(config.seed, split, episode, start),
            floor=number < config.noise_floor_episodes,
        )
        for number, (episode, donor) in enumerate(
            zip(chosen, [chosen[place] for place in order], strict=True)
        )
        for start, frames in windows(lengths[episode], config)
    ]


def choose_episodes(count: int, config: EvaluationConfig) -> list[int]:
    """Which of `count` episodes are taken, in order: the first ones, or a fixed draw as published.

    Under `acwm-phys` they are drawn by Python's own generator, ``random.Random(0).sample``.
    """
    wanted = min(count, config.episodes or count)
    if config.protocol == "acwm-phys":
        return sorted(random.Random(TRAJECTORY_SEED).sample(range(count), wanted))
    return list(range(wanted))


def windows(length: int, config: EvaluationConfig) -> list[tuple[int, int]]:
    """Start and frames of the clips of an episode of `length` frames.

    Under `acwm-phys` the starts are ``linspace(0, length − frames, cuts)`` without their
    fractions. A start that comes twice, because the episode is hardly longer than a window, is
    taken once, and an episode shorter than a window is one clip, shorter too.
    """
    frames = min(length, config.frames or length)
    if config.cuts is None:
        return [(0, frames)]
    starts = np.linspace(0, length - frames, config.cuts).astype(int)
    return [(start, frames) for start in np.unique(starts).tolist()]


def derangement(count: int, seed: int) -> list[int]:
    """A permutation of ``range(count)``, count ≥ 2, in which nothing keeps its place.

    It is one cycle through all, drawn uniformly (Sattolo 1986).
    """
    rng = np.random.default_rng(seed)
    order = list(range(count))
    for last in range(count - 1, 0, -1):
        other = int(rng.integers(last))
        order[last], order[other] = order[other], order[last]
    return order


def noise_seed(seed: int, split: str, episode: int, start: int = 0) -> int:
    """Seed of one clip's sampling noise, the same whatever else is evaluated beside it."""
    identity = [seed, [str(name) for name in SPLITS].index(split), episode, start]
    return int(np.random.SeedSequence(identity).generate_state(1)[0])
