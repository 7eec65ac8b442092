"""What is evaluated: clips of test episodes, and the four rows that predict each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.windows import window_actions
from acwm_core.episode import SPLITS, Episode
from acwm_core.errors import DataError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.shapes import Actions, Clip, Video
from acwm_core.world_model import CLIP_FRAMES, WorldModel

Kind = Literal["model", "shuffled", "copy", "codec"]
"""A row of the results, by what made its prediction:

* ``model``: the world model with the clip's actions.
* ``shuffled``: the same model and noise with another episode's actions.
* ``copy``: the first frame, standing still.
* ``codec``: the codec's own reconstruction of the truth, a ceiling for every model on it.
"""

KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class ClipPlan:
    """One clip to predict, decided before anything is read.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        donor: the other episode, whose actions the ``shuffled`` row is given.
        seed: of the sampling noise; depends on split and episode alone.
    """

    split: str
    episode: int
    donor: int
    seed: int


@dataclass(frozen=True)
class Sample:
    """A clip with all that the simulator knows of it, T frames from frame 0.

    Attributes:
        plan: which clip it is.
        episode: the episode it is cut from.
        video: `[T, 3, H, W]` float32 in [0, 1].
        actions: `[T, A]`, the last row zero.
        donor_actions: `[T, A]` of the donor.
    """

    plan: ClipPlan
    episode: Episode
    video: Clip
    actions: NDArray[np.float32]
    donor_actions: NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """Clips of equal length, on the model's device.

    Attributes:
        video: the truth, `[B, T, 3, H, W]`.
        actions: `[B, T, A]`.
        donor_actions: `[B, T, A]`.
        seeds: of the noise, one per clip.
    """

    video: Video
    actions: Actions
    donor_actions: Actions
    seeds: list[int]

    @classmethod
    def of(cls, samples: Sequence[Sample], device: torch.device) -> Batch:
        """Stack samples."""

        def stack(arrays: list[NDArray[np.float32]]) -> Tensor:
            return torch.as_tensor(np.stack(arrays), device=device)

        return cls(
            torch.stack([sample.video for sample in samples]).to(device),
            stack([sample.actions for sample in samples]),
            stack([sample.donor_actions for sample in samples]),
            [sample.plan.seed for sample in samples],
        )


Predictor = Callable[[Batch], Video]
"""Predicts `[B, T, 3, H, W]`, of which it may look at what its row is meant to know."""


def plan_clips(split: str, episodes: int, config: EvaluationConfig) -> list[ClipPlan]:
    """The clips of a split, one per episode.

    Args:
        split: test split.
        episodes: how many it has.
        config: decides how many are taken, and the seeds.

    Raises:
        DataError: fewer than two episodes, so that there is no other's actions to take.
    """
    count = min(episodes, config.episodes or episodes)
    if count < 2:
        raise DataError(
            f"{split} has {count} episode(s), and evaluation needs two, to predict one with the "
            "actions of another: generate more"
        )
    donors = derangement(count, config.seed)
    return [
        ClipPlan(split, episode, donors[episode], noise_seed(config.seed, split, episode))
        for episode in range(count)
    ]


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


def noise_seed(seed: int, split: str, episode: int) -> int:
    """Seed of one clip's sampling noise, the same whatever else is evaluated beside it."""
    identity = [seed, [str(name) for name in SPLITS].index(split), episode]
    return int(np.random.SeedSequence(identity).generate_state(1)[0])


def load_sample(plan: ClipPlan, episodes: EpisodeDataset, frames: int | None) -> Sample:
    """Read a clip of at most `frames` frames; a shorter episode is taken whole."""
    episode = episodes[plan.episode]
    length = min(len(episode.video), frames or len(episode.video))
    video = torch.as_tensor(episode.video[:length]).permute(0, 3, 1, 2).float() / 255
    actions = window_actions(episode.actions, 0, length)
    donated = window_actions(episodes.actions(plan.donor), 0, length)
    return Sample(plan, episode, video, actions, donated)


def batches(samples: Iterator[Sample], size: int) -> Iterator[list[Sample]]:
    """Group up to `size` consecutive samples of equal length."""
    group: list[Sample] = []
    for sample in samples:
        if group and (len(group) == size or len(sample.video) != len(group[0].video)):
            yield group
            group = []
        group.append(sample)
    if group:
        yield group


def predictors(
    world_model: WorldModel, *, steps: int | None = None, window: int = CLIP_FRAMES
) -> Mapping[Kind, Predictor]:
    """The predictor of every row.

    Args:
        world_model: in evaluation mode.
        steps: sampling steps; the flow's own by default.
        window: frames predicted at once; longer clips are predicted window by window.
    """

    def predict(batch: Batch, actions: Actions) -> Video:
        first = batch.video[:, 0]
        return world_model.rollout(first, actions, steps=steps, window=window, seeds=batch.seeds)

    return {
        "model": lambda batch: predict(batch, batch.actions),
        "shuffled": lambda batch: predict(batch, batch.donor_actions),
        "copy": lambda batch: batch.video[:, :1].expand_as(batch.video),
        "codec": lambda batch: world_model.codec(batch.video),
    }
