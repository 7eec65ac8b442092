"""The `Denoiser` interface: a dynamics model that predicts by removing noise from latents."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model import next_frame
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, DynamicsModel, LatentStream
from acwm_core.model.flow import Flow, drawn_noise
from acwm_core.model.shapes import Latent, Sigmas


class Denoiser(DynamicsModel):
    """A network that is evaluated on noisy latents; its `Flow` defines training and sampling.

    A denoiser that can be built causal or not takes the argument `causal: bool | None = None`. One
    that can look at the previous latent frame takes `previous: bool | None = None`. If a recipe
    leaves them None, the framework sets what the recipe's `flow.objective` needs.

    Attributes:
        flow: objective and sampler; the framework sets it from the recipe.
        previous: whether `forward` uses `conditioning.previous`, as `next_frame` needs.
    """

    flow: Flow
    previous: bool = False

    @property
    def streams_by_default(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether it was trained to predict one frame after the other."""
        return self.flow.objective == "next_frame"

    @property
    def sampling_steps(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Number of sampling steps of the flow."""
        return self.flow.steps

    @abstractmethod
    def forward(self, latents: Latent, sigma: Sigmas, conditioning: Conditioning) -> Latent:
        """Evaluate the network once. It predicts velocity or clean latents, as `flow.prediction`.

        Args:
            latents: noisy latents `[B, L, C, h, w]`; those of given frames are clean.
            sigma: noise level of each latent frame `[B, L]`, from 0 (clean) to 1 (noise).
            conditioning: the embedded actions; the model adds `modulation` to its timestep
                embedding, and calls `inject_input` once before its first layer and `inject` once
                after each layer.

        Returns:
            The prediction, in the shape of `latents`.
        """

    def loss(
        self, latents: Latent, conditioning: Conditioning, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """The flow's loss for one evaluation; see `DynamicsModel.loss`."""
        if self.flow.objective == "next_frame":
            return next_frame.loss(self, latents, conditioning, generators)
        return self.flow.loss(
            lambda noisy, sigma: self(noisy, sigma, conditioning),
            latents,
            generators,
            self.given_frames,
        )

    def predict(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[torch.Generator],
        steps: int | None = None,
    ) -> Latent:
        """Sample all frames at once, or one by one if trained with `next_frame`.

        See `DynamicsModel.predict`.
        """
        if self.flow.objective == "next_frame":
            return next_frame.predict(self, given, conditioning, frames, generators, steps)
        noise = drawn_noise((frames, *given.shape[2:]), generators).to(given)
        return self.flow.sample(
            lambda noisy, sigma: self(noisy, sigma, conditioning), noise, given, steps
        )

    def stream(
        self,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """Sample frame by frame with a cache; see `DynamicsModel.stream`."""
        if not self.causal:
            raise RecipeError(
                f"this {type(self).__name__} looks at later frames, which a stream does not have "
                "yet: train with flow.objective=diffusion_forcing to stream"
            )
        if self.flow.objective == "next_frame":
            cache = self.new_cache(context)
            return next_frame.NextFrameStream(self, given, generators, steps, cache)
        if self.flow.objective == "full_sequence":
            raise RecipeError(
                "a model trained with flow.objective=full_sequence (one noise level per clip) "
                "cannot be streamed: train with flow.objective=diffusion_forcing or next_frame"
            )
        return _DenoisedStream(self, given, generators, steps, self.new_cache(context))

    def new_cache(self, context: int) -> Cache:
        """Create an empty cache for `extend`, in which a latent frame sees the last `context` ones.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(
            f"{type(self).__name__} has no cache of earlier frames, so it cannot be streamed"
        )

    def extend(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, cache: Cache
    ) -> Latent:
        """Evaluate the latent frames that follow those in `cache`. Optional, for causal models.

        The result equals an evaluation of all frames since the start at once, in which earlier
        frames have the latents and noise levels they were cached with, and each frame sees the last
        `cache.context` ones in every layer. Nothing is cached until `cache.keep` is called, so the
        same frames can be evaluated repeatedly.

        Args:
            latents: `[B, n, C, h, w]`, n ≥ 1.
            sigma: noise levels `[B, n]`.
            conditioning: of these n frames.
            cache: from this model's `new_cache`, for one batch size and frame size.

        Returns:
            The prediction, in the shape of `latents`.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(f"{type(self).__name__} has no cache of earlier frames")


class _DenoisedStream(LatentStream):
    """Samples latent frames one after the other, each with the cached past.

    A finished latent frame is evaluated once more, clean, so that later frames can attend to it.
    This is done in the same evaluation as the first one of the next frame.
    """

    def __init__(
        self,
        model: Denoiser,
        given: Latent,
        generators: Sequence[torch.Generator],
        steps: int | None,
        cache: Cache,
    ) -> None:
        self._model, self._cache, self._steps = model, cache, steps
        self._generators = generators
        self._unkept: Latent | None = given
        self._shape = given.shape[2:]

    def advance(self, conditioning: Conditioning) -> Latent:
        """Sample the next latent frame; see `LatentStream.advance`."""
        assert self._unkept is not None
        done = self._unkept.shape[1]
        alone = conditioning.frames(done, done + 1)

        def denoise(noisy: Latent, sigma: Sigmas) -> Latent:
            if self._unkept is None:
                return self._model.extend(noisy, sigma, alone, self._cache)
            pair = torch.cat([self._unkept, noisy], 1)
            level = functional.pad(sigma, (done, 0))
            predicted = self._model.extend(pair, level, conditioning, self._cache)
            self._cache.keep(done)
            self._unkept = None
            return predicted[:, done:]

        noise = drawn_noise((1, *self._shape), self._generators).to(self._unkept)
        self._unkept = self._model.flow.sample(denoise, noise, noise[:, :0], self._steps)
        return self._unkept
