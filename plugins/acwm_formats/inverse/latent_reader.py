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
from acwm_formats.inverse.action_decoder import ActionDecoder, DecoderQuality
from acwm_formats.inverse.latent_network import HIGHEST, LatentDynamics, change
from acwm_formats.inverse.network import window
from acwm_formats.inverse.reader import Floats, explained, small, up_to
from acwm_formats.inverse.training import BATCH, Moment, train_on_moments

SIDE = 32
"""Rows or columns to which larger frames are averaged: a step takes a quarter of that of 64."""

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

    def fit_decoder(self, recorded: EpisodeDataset) -> DecoderQuality:
        """Fit a map from latent to recorded actions, and try it on held-out episodes.

        Raises:
            DataError: there is one recorded episode, or one has a single frame.
        """
        check_lengths(recorded)
        training, held = hold_out(len(recorded), None)
        decoder = ActionDecoder.fit(*self._pairs(recorded, training))
        latents, wanted = self._pairs(recorded, held)
        shares = explained(
            wanted, decoder(latents), np.where(wanted.std(0) > 0, wanted.var(0), np.nan)
        )
        return DecoderQuality(decoder, len(training), len(held), tuple(shares.tolist()))

    def _pairs(self, recorded: EpisodeDataset, indices: Sequence[int]) -> tuple[Floats, Floats]:
        """Latent and recorded actions of some episodes."""
        latents = [self.read(recorded.video(index)) for index in indices]
        actions = [recorded.actions(index)[:-1] for index in indices]
        return np.concatenate(latents), np.concatenate(actions)

    def _train(self, frames: Sequence[Tensor], steps: int, seed: int, progress: bool) -> None:
        def loss_of_batch(seen: Tensor, _: Sequence[Moment]) -> Tensor:
            predicted = self._network(seen, self._network.latents(seen))
            return functional.mse_loss(predicted, change(seen))

        options = {"steps": steps, "seed": seed, "progress": progress}
        what = "learning latent actions"
        train_on_moments(self._network, frames, loss_of_batch, what=what, **options)

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
            for place, latent in enumerate((own, other)):
                sums[place] += (self._network(seen, latent) - true).square().sum()
            sums[2] += true.square().sum()
        own_share, other_share = (1 - sums[:2] / sums[2].clamp(min=1e-12)).tolist()
        counts = torch.unique(every, dim=0, return_counts=True)[1].double()
        used = (counts / counts.sum()).log().mul(-counts / counts.sum()).sum().exp().item()
        possible = (2 * HIGHEST + 1) ** self.dimensions
        return LatentQuality(len(frames), own_share, other_share, used, possible)


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
