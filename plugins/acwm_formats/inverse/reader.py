"""Learns to read actions from the labelled episodes of a dataset, and how well it does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.clips import hold_out
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.inverse.network import InverseDynamics, loss_of, window
from acwm_formats.inverse.training import BATCH, Moment, train_on_moments

Floats = NDArray[np.float32]

SIDE, MOST_FRAMES = 64, 30_000
"""Rows or columns to which larger frames are averaged; how many labelled frames are used."""

STILL = 1e-6
"""Deviation, as a share of the largest action, below which a dimension never changes."""


class ActionEstimates(NamedTuple):
    """Actions that were read in an episode of T frames.

    Attributes:
        actions: `[T − 1, A]` in the units of the card.
        confidence: `[T − 1]`, the share of the variance of actions that is expected to be
            explained, 0 to 1.
    """

    actions: Floats
    confidence: Floats


@dataclass(frozen=True)
class Quality:
    """How well actions of held-out labelled episodes are read.

    Attributes:
        episodes, rows: how many there are.
        explained: R² of each dimension; NaN if it never changes.
        error: mean absolute error of each dimension, in its unit.
        surer: mean R² of the half of the actions with more confidence.
        less_sure: that of the others.
    """

    episodes: int
    rows: int
    explained: tuple[float, ...]
    error: tuple[float, ...]
    surer: float
    less_sure: float

    @property
    def mean(self) -> float:
        """Mean R² of the dimensions that change."""
        return float(np.nanmean(self.explained))


class ActionReader:
    """An inverse dynamics model of one dataset.

    Args:
        episodes: labelled ones; the last are held out.
        steps: training steps.
        seed: of the weights and the order.
        progress: whether to show a progress bar.

    Attributes:
        quality: on the held-out episodes.

    Raises:
        DataError: there is a single episode, or no action ever changes.
    """

    def __init__(
        self, episodes: EpisodeDataset, *, steps: int, seed: int = 0, progress: bool = True
    ) -> None:
        if len(episodes) < 2:
            raise DataError(f"{episodes.path} has one labelled episode: two are needed, to test")
        training, held = hold_out(len(episodes), None)
        chosen = list(up_to(episodes, training))
        actions = [episodes.actions(index)[:-1] for index in chosen]
        every = np.concatenate(actions)
        self._low, self._high = (
            np.array(bound, np.float32)
            for bound in (
                episodes.card.environment.action.low,
                episodes.card.environment.action.high,
            )
        )
        self._mean, std = every.mean(0), every.std(0)
        self._varies = std > STILL * max(float(np.abs(every).max()), STILL)
        if not self._varies.any():
            raise DataError(f"no action of {episodes.path} ever changes, so none can be learnt")
        self._std = np.where(self._varies, std, 1).astype(np.float32)
        torch.manual_seed(seed)
        self._network = InverseDynamics(every.shape[1])
        self._scale = np.ones(every.shape[1], np.float32)
        frames = [small(episodes.video(index)) for index in chosen]
        self._train(frames, actions, steps, seed, progress)
        self.quality = self._tested(episodes, held)

    def read(self, video: NDArray[np.uint8]) -> ActionEstimates:
        """Read the actions of an episode `[T, 3, H, W]` uint8."""
        mean, variance = self._estimates(small(video))
        actions = np.clip(mean * self._std + self._mean, self._low, self._high)
        return ActionEstimates(actions.astype(np.float32), self._confidence(variance))

    def _confidence(self, variance: Floats) -> Floats:
        shares = np.clip(1 - variance * self._scale, 0, 1)[:, self._varies]
        return shares.mean(1).astype(np.float32)

    @torch.inference_mode()
    def _estimates(self, frames: Tensor) -> tuple[Floats, Floats]:
        """Means and variances `[T − 1, A]`, in standard units."""
        parts: list[tuple[Tensor, Tensor]] = []
        for start in range(0, len(frames) - 1, BATCH):
            moments = range(start, min(start + BATCH, len(frames) - 1))
            parts.append(self._network(torch.stack([window(frames, k) for k in moments])))
        mean, log_variance = (torch.cat(rows).numpy() for rows in zip(*parts, strict=True))
        return mean, np.exp(log_variance)

    def _train(
        self,
        frames: Sequence[Tensor],
        actions: Sequence[Floats],
        steps: int,
        seed: int,
        progress: bool,
    ) -> None:
        def loss_of_batch(seen: Tensor, batch: Sequence[Moment]) -> Tensor:
            rows = np.stack([actions[e][k] for e, k in batch])
            wanted = torch.from_numpy((rows - self._mean) / self._std)
            mean, log_variance = self._network(seen)
            return loss_of(mean, log_variance, wanted)

        options = {"steps": steps, "seed": seed, "progress": progress}
        train_on_moments(self._network, frames, loss_of_batch, what="learning actions", **options)

    def _tested(self, episodes: EpisodeDataset, held: Sequence[int]) -> Quality:
        """Measure it on held-out episodes, and scale the variances to the errors there."""
        true = [(episodes.actions(index)[:-1] - self._mean) / self._std for index in held]
        estimates = [self._estimates(small(episodes.video(index))) for index in held]
        wanted = np.concatenate(true)
        mean, variance = (np.concatenate(rows) for rows in zip(*estimates, strict=True))
        squares = (wanted - mean) ** 2
        self._scale = (squares / variance).mean(0)
        confidence = self._confidence(variance)
        order = np.argsort(-confidence)
        halves = np.array_split(order, 2)
        spread = np.where(self._varies, wanted.var(0), np.nan)
        surer, less_sure = (explained(wanted[half], mean[half], spread) for half in halves)
        return Quality(
            len(held),
            len(wanted),
            tuple(explained(wanted, mean, spread).tolist()),
            tuple((np.abs(wanted - mean).mean(0) * self._std).tolist()),
            float(np.nanmean(surer)),
            float(np.nanmean(less_sure)),
        )


def explained(wanted: Floats, read: Floats, variance: Floats) -> Floats:
    """R² of each dimension of actions `[N, A]`, whose `variance` is NaN if it never changes."""
    shares = 1 - ((wanted - read) ** 2).mean(0) / np.maximum(variance, 1e-12)
    return shares.astype(np.float32)


def small(video: NDArray[np.uint8], side: int = SIDE) -> Tensor:
    """Frames `[T, 3, H, W]` uint8, averaged down by a whole factor to about `side` rows."""
    factor = max(1, min(video.shape[2:]) // side)
    frames = torch.tensor(video)
    if factor == 1:
        return frames
    return torch.nn.functional.avg_pool2d(frames.float(), factor).round().byte()


def up_to(episodes: EpisodeDataset, indices: Sequence[int]) -> Iterator[int]:
    """The first episodes, of up to `MOST_FRAMES` frames together."""
    frames = 0
    for index in indices:
        frames += episodes.lengths[index]
        if frames > MOST_FRAMES and index:
            return
        yield index
