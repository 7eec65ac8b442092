"""Which clips are predicted, their data, and the rows that predict them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.clips import window_actions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import SPLITS, Episode
from acwm_core.errors import DataError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import protocol_named
from acwm_core.model.shapes import Actions, Clip, Video

Predictor = Literal["model", "shuffled", "copy", "codec", "truth", "perturbed"]
"""A row of the results, named after what made its prediction:

* ``model``: the world model with the clip's actions.
* ``shuffled``: the same model and noise with another episode's actions.
* ``copy``: the first frame, repeated.
* ``codec``: the codec's reconstruction of the truth, a ceiling for every model that uses it.
* ``truth``: the true video itself, for metrics that read states from video. It gives their noise
  floor: smaller scores say more about the estimator than about a model.
* ``perturbed``: the simulator with the clip's actions, started slightly elsewhere, for a few clips.
  It shows what no model can predict.
"""

PREDICTORS: tuple[Predictor, ...] = ("model", "shuffled", "copy", "codec", "truth")
"""The rows that need only the dataset and the model."""


@dataclass(frozen=True)
class ClipPlan:
    """One clip to predict, decided before any video is read.

    It is identified by split, episode and start.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame with which the clip starts; the model is given this frame.
        frames: length of the clip.
        donor: the other episode, whose actions the ``shuffled`` row is given.
        donor_start: the donor's frame from which its actions are taken.
        seed: seed of the sampling noise; depends on the evaluation's seed, split, episode and
            start only.
        noise_floor: whether states are read from the true video and the codec's reconstruction.
        given: number of context frames.
    """

    split: str
    episode: int
    start: int
    frames: int
    donor: int
    donor_start: int
    seed: int
    noise_floor: bool = True
    given: int = 1

    def scored(self, episode: Episode, target: Clip, made: Clip) -> tuple[Episode, Clip, Clip]:
        """The clip, its video and a prediction from the last context frame on, for the metrics."""
        known = self.given - 1
        cut = cut_episode(episode, known, len(episode.video) - known) if known else episode
        return cut, target[known:], made[known:]

    @property
    def where(self) -> str:
        """A description of the clip for messages."""
        return f"in episode {self.episode} of {self.split}, from frame {self.start}"


@dataclass(frozen=True)
class Sample:
    """A clip of T frames with everything recorded about it.

    Attributes:
        plan: which clip it is.
        episode: the part of the episode that the plan selects, see `cut_episode`.
        video: `[T, 3, H, W]` float32 in [0, 1].
        donor_actions: the donor's actions `[T, A]`, except between context frames, where they are
            the clip's own; the last row is zero.
    """

    plan: ClipPlan
    episode: Episode
    video: Clip
    donor_actions: NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """Clips of equal length on the model's device: the truth, actions, and seeds of the noise.

    The first `given` frames of the truth are the model's context frames.
    """

    video: Video
    actions: Actions
    donor_actions: Actions
    seeds: list[int]
    given: int = 1

    @classmethod
    def of(cls, samples: Sequence[Sample], device: torch.device) -> Batch:
        """Stack samples."""
        return cls(
            torch.stack([sample.video for sample in samples]).to(device),
            torch.as_tensor(np.stack([s.episode.actions for s in samples]), device=device),
            torch.as_tensor(np.stack([s.donor_actions for s in samples]), device=device),
            [sample.plan.seed for sample in samples],
            samples[0].plan.given,
        )


def plan_clips(
    split: str, lengths: Sequence[int], config: EvaluationConfig, given: int = 1
) -> list[ClipPlan]:
    """The clips of a split with episodes of these lengths, in order, with `given` context frames.

    Raises:
        DataError: fewer than two episodes, so that there are no other episode's actions to use; or
            a clip that is not longer than its context frames.
    """
    protocol = protocol_named(config.protocol)
    chosen = protocol.episodes(len(lengths), config)
    if len(chosen) < 2:
        raise DataError(
            f"{split} has {len(chosen)} episode(s), but evaluation needs two, to predict one with "
            "the actions of the other: generate more"
        )
    donors = [chosen[place] for place in derangement(len(chosen), config.seed)]
    plans = [
        ClipPlan(
            split,
            episode,
            start,
            frames,
            donor=donor,
            donor_start=max(0, min(start, lengths[donor] - frames)),
            seed=noise_seed(config.seed, split, episode, start),
            noise_floor=number < config.noise_floor_episodes,
            given=given,
        )
        for number, (episode, donor) in enumerate(zip(chosen, donors, strict=True))
        for start, frames in protocol.windows(lengths[episode], config)
    ]
    short = [plan for plan in plans if given > 1 and plan.frames <= given]
    if short:
        raise DataError(
            f"a clip of episode {short[0].episode} of {split} has {short[0].frames} frames, of "
            f"which {given} are given: set a lower evaluation.context_frames"
        )
    return plans


def derangement(count: int, seed: int) -> list[int]:
    """A permutation of ``range(count)``, count ≥ 2, in which nothing keeps its place.

    It is a single cycle through all elements, drawn uniformly (Sattolo 1986).
    """
    rng = np.random.default_rng(seed)
    order = list(range(count))
    for last in range(count - 1, 0, -1):
        other = int(rng.integers(last))
        order[last], order[other] = order[other], order[last]
    return order


def noise_seed(seed: int, split: str, episode: int, start: int = 0) -> int:
    """The seed of one clip's sampling noise, independent of which other clips are evaluated."""
    identity = [seed, [*map(str, SPLITS)].index(split), episode, start]
    return int(np.random.SeedSequence(identity).generate_state(1)[0])


def load_samples(plans: Iterable[ClipPlan], episodes: EpisodeDataset) -> Iterator[Sample]:
    """Read clips one after the other; consecutive clips of an episode decode it only once."""
    for number, group in itertools.groupby(plans, lambda plan: plan.episode):
        episode = episodes[number]
        for plan in group:
            clip = cut_episode(episode, plan.start, plan.frames)
            donated = window_actions(episodes.actions(plan.donor), plan.donor_start, plan.frames)
            donated[: plan.given - 1] = clip.actions[: plan.given - 1]
            yield Sample(plan, clip, as_clip(clip.video), donated)


def as_clip(video: NDArray[np.uint8]) -> Clip:
    """A video `[T, H, W, 3]` uint8 as a clip `[T, 3, H, W]` float32 in [0, 1].

    It is contiguous with channels first, like predictions: pixel metrics then take a third of the
    time.
    """
    return torch.as_tensor(video).permute(0, 3, 1, 2).contiguous().float() / 255


def cut_episode(episode: Episode, start: int, frames: int) -> Episode:
    """The frames ``start … start + frames − 1`` of an episode, as if it had begun with them.

    Frame numbers of contacts are relative to the window's first frame; contacts in the interval
    before it are kept as frame 0. The last row of actions leads out of the window and is zero.
    """
    inside = slice(start, start + frames)
    contacts = episode.contacts - np.array([start, 0, 0], episode.contacts.dtype)
    kept = (contacts[:, 0] >= 0) & (contacts[:, 0] < frames)
    return replace(
        episode,
        video=episode.video[inside],
        actions=window_actions(episode.actions, start, frames),
        states={name: values[inside] for name, values in episode.states.items()},
        masks=episode.masks[inside],
        contacts=contacts[kept],
    )


def batches(samples: Iterator[Sample], size: int) -> Iterator[list[Sample]]:
    """Group up to `size` consecutive samples of equal length."""
    for _, alike in itertools.groupby(samples, lambda sample: len(sample.video)):
        while group := list(itertools.islice(alike, size)):
            yield group
