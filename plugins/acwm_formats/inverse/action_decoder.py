"""A linear map from latent actions to recorded ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_formats.inverse.latent_network import HIGHEST

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

RIDGE = 1.0
"""Penalty of the squared weights, in standard units."""


@dataclass(frozen=True)
class ActionDecoder:
    """A linear map from the levels of latent actions to recorded actions.

    Attributes:
        weights: `[A, D · levels]` of each level of each dimension, in the units of the actions.
        offset: `[A]`.
    """

    weights: Doubles
    offset: Doubles

    @classmethod
    def fit(cls, latents: Floats, actions: Floats) -> ActionDecoder:
        """Fit it by ridge regression to moments with latent `[N, D]` and recorded actions."""
        seen, known = one_hot_levels(latents), actions.astype(np.float64)
        spread = np.where(known.std(0) > 0, known.std(0), 1)
        centre, mean = seen.mean(0), known.mean(0)
        square = (seen - centre).T @ (seen - centre) + RIDGE * np.eye(seen.shape[1])
        weights = np.linalg.solve(square, (seen - centre).T @ (known - mean) / spread).T
        weights = weights * spread[:, None]
        return cls(weights, mean - weights @ centre)

    def __call__(self, latents: Floats) -> Floats:
        """The actions `[N, A]` that belong to latent ones `[N, D]`."""
        return (one_hot_levels(latents) @ self.weights.T + self.offset).astype(np.float32)


@dataclass(frozen=True)
class DecoderQuality:
    """How latent actions relate to recorded ones.

    Attributes:
        decoder: the map.
        recorded: number of episodes that it was fitted to.
        episodes: number of those that were held out.
        explained: R² on these of each dimension of the action; NaN if it never changes.
    """

    decoder: ActionDecoder
    recorded: int
    episodes: int
    explained: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean R² of the dimensions that change; NaN if none does."""
        changing = [share for share in self.explained if share == share]
        return float(np.mean(changing)) if changing else float("nan")


def one_hot_levels(latents: Floats) -> Doubles:
    """Latent actions `[N, D]` as a one for the level of each dimension, `[N, D · levels]`."""
    levels = np.arange(-HIGHEST, HIGHEST + 1)
    return (latents[..., None] == levels).reshape(len(latents), -1).astype(np.float64)
