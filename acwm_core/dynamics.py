"""The `DynamicsModel` interface: the network that denoises latents."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import nn

from acwm_core.conditioner import Conditioning
from acwm_core.errors import RecipeError
from acwm_core.shapes import Latent, Sigmas


class Cache(ABC):
    """What a causal model keeps of the latent frames that went before, in constant memory.

    Args:
        context: latent frames that a frame sees, its own included; at least 2.

    Attributes:
        frames: latent frames kept since the start, also those that have left the context.

    Raises:
        RecipeError: a context below 2, which remembers nothing.
    """

    def __init__(self, context: int) -> None:
        if context < 2:
            raise RecipeError(f"a context of {context} latent frames remembers nothing: at least 2")
        self.context = context
        self.frames = 0

    @abstractmethod
    def keep(self, frames: int) -> None:
        """Make the first `frames` of those evaluated last the past of those to come."""


class DynamicsModel(nn.Module, ABC):
    """Predicts, from noisy latents, what the recipe's flow asks for (velocity or clean latent).

    Every model takes the keyword argument `latent_channels`, which the framework fills in from the
    codec; its own parameters come after it and are set in the recipe. The latent size h × w and the
    length L are those of the input; a model refuses with a `ShapeError` what it cannot take.

    A model that can be built causal or not takes `causal: bool | None = None`. Where a recipe
    leaves it None, the framework fills in what the recipe's objective wants (`flow.objective`).

    Attributes:
        width: token width D, given to the conditioner.
        layers: number of layers after which the conditioner may act.
        heads: attention heads, given to the conditioner.
        causal: whether what it predicts of a latent frame depends on no later one.
    """

    width: int
    layers: int
    heads: int
    causal: bool = False

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

    def new_cache(self, context: int) -> Cache:
        """An empty cache for `extend`, where a latent frame sees the last `context` ones.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(
            f"{type(self).__name__} keeps nothing of earlier frames, so it cannot be streamed"
        )

    def extend(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, cache: Cache
    ) -> Latent:
        """Evaluate the latent frames that follow those in `cache`; a causal model may offer it.

        The result is that of all frames since the start evaluated at once, earlier ones with the
        latents and noise levels they were kept with, each frame seeing the `cache.context` last
        ones in every layer. Nothing is kept before `cache.keep` is called, so the same frames may
        be evaluated again and again.

        Args:
            latents: `[B, n, C, h, w]`, n ≥ 1.
            sigma: `[B, n]`.
            conditioning: of these n frames.
            cache: of this model's `new_cache`, for one batch and frame size.

        Returns:
            The prediction, of the shape of `latents`.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(f"{type(self).__name__} has no cache of earlier frames")
