"""Learns latent actions of a dataset's videos, and how they relate to recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from acwm_core.data.clips import hold_out
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.executors import progress_bar
from acwm_formats.inverse.latent_network import HIGHEST, LatentDynamics, change
from acwm_formats.inverse.network import window
from acwm_formats.inverse.reader import BATCH, Floats, explained, small, up_to

Doubles = NDArray[np.float64]

SIDE = 32
"""Rows or columns to which larger frames are averaged: a step takes a quarter of that of 64."""

RATE = 2e-3

RIDGE = 1.0
"""Penalty of the squared weights of the map to recorded actions, in standard units."""

COLLAPSED = 1.2
"""Number of codes in effective use below which the latent actions say nothing."""


@dataclass(frozen=True)
class LatentQuality:
    """What latent actions say of held-out episodes.

    Attributes:
        episodes: how many there are.
        explained: share of the change from frame to frame that is predicted with the latent action.
        shuffled: with that of another moment instead.
        codes: number of codes in effective use, the exponential of their entropy.
        possible: number of codes that there are.
    """

    episodes: int
    explained: float
    shuffled: float
    codes: float
    possible: int

    @property
    def collapsed(self) -> bool:
        """Whether nearly all moments have one code."""
        return self.codes < COLLAPSED


@dataclass(frozen=True)
class Tie:
    """A linear map from the levels of latent actions to recorded actions.

    Attributes:
        weights: `[A, D · levels]` of each level of each dimension, in the units of the actions.
        offset: `[A]`.
    """

    weights: Doubles
    offset: Doubles

    @classmethod
    def fit(cls, latents: Floats, actions: Floats) -> Tie:
        """Fit it by ridge regression to moments with latent `[N, D]` and recorded actions."""
        seen, known = levels_apart(latents), actions.astype(np.float64)
        spread = np.where(known.std(0) > 0, known.std(0), 1)
        centre, mean = seen.mean(0), known.mean(0)
        square = (seen - centre).T @ (seen - centre) + RIDGE * np.eye(seen.shape[1])
        weights = np.linalg.solve(square, (seen - centre).T @ (known - mean) / spread).T
        weights = weights * spread[:, None]
        return cls(weights, mean - weights @ centre)

    def __call__(self, latents: Floats) -> Floats:
        """The actions `[N, A]` that belong to latent ones `[N, D]`."""
        return (levels_apart(latents) @ self.weights.T + self.offset).astype(np.float32)


@dataclass(frozen=True)
class TieQuality:
    """How latent actions relate to recorded ones.

    Attributes:
        tie: the map.
        recorded: number of episodes that it was fitted to.
        episodes: number of those that were held out.
        explained: R² on these of each dimension of the action; NaN if it never changes.
    """

    tie: Tie
    recorded: int
    episodes: int
    explained: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean R² of the dimensions that change; NaN if none does."""
        changing = [share for share in self.explained if share == share]
        return float(np.mean(changing)) if changing else float("nan")


class LatentReader:
    """Latent actions of one dataset.

    Args:
        episodes: those to learn from; the last are held out.
        dimensions: number D of whole numbers in an action.
        steps: training steps.
        seed: of the weights and the order.
        progress: whether to show a progress bar.

    Attributes:
        quality: on the held-out episodes.

    Raises:
        DataError: there are fewer than two episodes, or one has a single frame, or nothing moves.
    """

    def __init__(
        self,
        episodes: EpisodeDataset,
        dimensions: int,
        *,
        steps: int,
        seed: int = 0,
        progress: bool = True,
    ) -> None:
        check_lengths(episodes)
        training, held = hold_out(len(episodes), None)
        torch.manual_seed(seed)
        self.dimensions, self._network = dimensions, LatentDynamics(dimensions)
        frames = [small(episodes.video(index), SIDE) for index in up_to(episodes, training)]
        if not any((video[1:] != video[:-1]).any() for video in frames):
            raise DataError(f"nothing ever changes in the videos of {episodes.path}")
        self._train(frames, steps, seed, progress)
        self._network.eval()
        self.quality = self._tested([small(episodes.video(index), SIDE) for index in held])

    @torch.inference_mode()
    def read(self, video: NDArray[np.uint8]) -> Floats:
        """The latent actions `[T − 1, D]` of an episode `[T, 3, H, W]` uint8, whole numbers."""
        parts = [self._network.latents(batch).round() for batch in _batches(small(video, SIDE))]
        return torch.cat(parts).numpy()

    def tie(self, recorded: EpisodeDataset) -> TieQuality:
        """Fit a map from latent to recorded actions, and try it on held-out episodes.

        Raises:
            DataError: there is one recorded episode, or one has a single frame.
        """
        check_lengths(recorded)
        training, held = hold_out(len(recorded), None)
        tie = Tie.fit(*self._pairs(recorded, training))
        latents, wanted = self._pairs(recorded, held)
        shares = explained(wanted, tie(latents), np.where(wanted.std(0) > 0, wanted.var(0), np.nan))
        return TieQuality(tie, len(training), len(held), tuple(shares.tolist()))

    def _pairs(self, recorded: EpisodeDataset, indices: Sequence[int]) -> tuple[Floats, Floats]:
        """Latent and recorded actions of some episodes."""
        latents = [self.read(recorded.video(index)) for index in indices]
        actions = [recorded.actions(index)[:-1] for index in indices]
        return np.concatenate(latents), np.concatenate(actions)

    def _train(self, frames: Sequence[Tensor], steps: int, seed: int, progress: bool) -> None:
        moments = [(e, k) for e, video in enumerate(frames) for k in range(len(video) - 1)]
        optimiser = torch.optim.AdamW(self._network.parameters(), RATE, weight_decay=0.01)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, steps, pct_start=0.1)
        rng = torch.Generator().manual_seed(seed)
        with progress_bar("learning latent actions", steps, unit="steps", shown=progress) as report:
            for _ in range(steps):
                places = torch.randint(len(moments), (BATCH,), generator=rng).tolist()
                batch = [moments[place] for place in places]
                seen = torch.stack([window(frames[e], k) for e, k in batch])
                predicted = self._network(seen, self._network.latents(seen))
                loss = functional.mse_loss(predicted, change(seen))
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                schedule.step()
                report(1)

    @torch.inference_mode()
    def _tested(self, frames: Sequence[Tensor]) -> LatentQuality:
        """Measure on held-out episodes what latent actions say."""
        sums = torch.zeros(3, dtype=torch.float64)
        batches = [batch for video in frames for batch in _batches(video)]
        latents = [self._network.latents(batch).round() for batch in batches]
        every = torch.cat(latents)
        order = torch.randperm(len(every), generator=torch.Generator().manual_seed(0))
        others = every[order].split([len(part) for part in latents])
        for seen, own, other in zip(batches, latents, others, strict=True):
            true = change(seen)
            for place, told in enumerate((own, other)):
                sums[place] += (self._network(seen, told) - true).square().sum()
            sums[2] += true.square().sum()
        own_share, other_share = (1 - sums[:2] / sums[2].clamp(min=1e-12)).tolist()
        counts = torch.unique(every, dim=0, return_counts=True)[1].double()
        used = (counts / counts.sum()).log().mul(-counts / counts.sum()).sum().exp().item()
        possible = (2 * HIGHEST + 1) ** self.dimensions
        return LatentQuality(len(frames), own_share, other_share, used, possible)


def levels_apart(latents: Floats) -> Doubles:
    """Latent actions `[N, D]` as a one for the level of each dimension, `[N, D · levels]`."""
    levels = np.arange(-HIGHEST, HIGHEST + 1)
    return (latents[..., None] == levels).reshape(len(latents), -1).astype(np.float64)


def check_lengths(episodes: EpisodeDataset, least: int = 2) -> None:
    """Refuse what is too little to learn what happens between two frames.

    Raises:
        DataError: there are fewer than `least` episodes, or one has a single frame.
    """
    if len(episodes) < least:
        raise DataError(f"{episodes.path} has {len(episodes)} episode: two are needed, to test")
    if min(episodes.lengths, default=2) < 2:
        index = episodes.lengths.index(min(episodes.lengths))
        raise DataError(
            f"episode {index} of {episodes.split} of {episodes.path} has a single frame, between "
            "which and the next nothing can be read: import the data again without it"
        )


def _batches(frames: Tensor) -> list[Tensor]:
    """The windows of all moments of an episode, in batches."""
    moments = torch.arange(len(frames) - 1).split(BATCH)
    return [torch.stack([window(frames, k) for k in part.tolist()]) for part in moments]
