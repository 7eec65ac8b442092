"""The `DynamicsModel` interface: the network that denoises latents."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import nn

from acwm_core.conditioner import Conditioning
from acwm_core.shapes import Latent, Sigmas


class DynamicsModel(nn.Module, ABC):
    """Predicts, from noisy latents, what the recipe's flow asks for (velocity or clean latent).

    Every model takes the keyword argument `latent_channels`, which the framework fills in from the
    codec; its own parameters come after it and are set in the recipe. The latent size h × w and the
    length L are those of the input; a model refuses with a `ShapeError` what it cannot take.

    Attributes:
        width: token width D, given to the conditioner.
        layers: number of layers after which the conditioner may act.
        heads: attention heads, given to the conditioner.
    """

    width: int
    layers: int
    heads: int

    @abstractmethod
    def forward(self, latents: Latent, sigma: Sigmas, conditioning: Conditioning) -> Latent:
        """One evaluation.

        Args:
            latents: noisy latents `[B, L, C, h, w]`; frame 0 is the clean first frame.
            sigma: noise level of each latent frame `[B, L]`, 0 clean to 1 noise.
            conditioning: the embedded actions; the model adds `modulation` to its timestep
                embedding and calls `inject` after each layer.

        Returns:
            The prediction, of the shape of `latents`.
        """
