"""The `Denoiser`: a dynamics model that predicts by removing noise from latents."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core import next_frame
from acwm_core.conditioner import Conditioning
from acwm_core.dynamics import Cache, DynamicsModel, LatentStream
from acwm_core.errors import RecipeError
from acwm_core.errors.plugin_code import shaped
from acwm_core.flow import Flow, drawn_noise
from acwm_core.shapes import Latent, Sigmas


class Denoiser(DynamicsModel):
    """A network that is evaluated on noisy latents; a `Flow` says how it learns and is sampled.

    A denoiser that can be built causal or not takes `causal: bool | None = None`, and one that can
    look at the latent frame before each one takes `previous: bool | None = None`. Where a recipe
    leaves them None, the framework fills in what the recipe's objective wants (`flow.objective`).

    Attributes:
        flow: objective and sampler; the framework sets it from the recipe.
        previous: whether `forward` looks at `conditioning.previous`, as `next_frame` needs.
    """

    flow: Flow
    previous: bool = False

    @property
    def streams_by_default(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Where it learned to predict one frame after the other."""
        return self.flow.objective == "next_frame"

    @property
    def sampling_steps(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Those of the flow."""
        return self.flow.steps

    @abstractmethod
    def forward(self, latents: Latent, sigma: Sigmas, conditioning: Conditioning) -> Latent:
        """One evaluation: what the recipe's flow asks for, velocity or clean latent.

        Args:
            latents: noisy latents `[B, L, C, h, w]`; those of given frames are clean.
            sigma: noise level of each latent frame `[B, L]`, 0 clean to 1 noise.
            conditioning: the embedded actions; the model adds `modulation` to its timestep
                embedding and calls `inject` after each layer.

        Returns:
            The prediction, of the shape of `latents`.
        """

    def loss(
        self, latents: Latent, conditioning: Conditioning, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """The flow's loss of one evaluation; see `DynamicsModel.loss`."""
        if self.flow.objective == "next_frame":
            return next_frame.loss(self, latents, conditioning, generators)
        return self.flow.loss(
            lambda noisy, sigma: self._evaluated(noisy, sigma, conditioning),
            latents,
            generators,
            self.given_frames,
        )

    def _evaluated(self, latents: Latent, sigma: Sigmas, conditioning: Conditioning) -> Latent:
        return shaped(self, "forward", self(latents, sigma, conditioning), *latents.shape)

    def predict(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[torch.Generator],
        steps: int | None = None,
    ) -> Latent:
        """Sample all frames at once, or one by one after `next_frame`; `DynamicsModel.predict`."""
        if self.flow.objective == "next_frame":
            return next_frame.predict(self, given, conditioning, frames, generators, steps)
        noise = drawn_noise((frames, *given.shape[2:]), generators).to(given)
        return self.flow.sample(
            lambda noisy, sigma: self._evaluated(noisy, sigma, conditioning), noise, given, steps
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
                "a model trained with one noise level per clip has not learned to continue from a "
                "clean past: train with flow.objective=diffusion_forcing to stream"
            )
        return _DenoisedStream(self, given, generators, steps, self.new_cache(context))

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


class _DenoisedStream(LatentStream):
    """Latent frames sampled one after the other, each with the cached past before it.

    A latent frame that is done goes into the model once more, clean, for later ones to look back
    on. That evaluation is made together with the first of the next frame.
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
        """The next latent frame; see `LatentStream.advance`."""
        assert self._unkept is not None
        done = self._unkept.shape[1]
        alone = conditioning.frames(done, done + 1)

        def denoise(noisy: Latent, sigma: Sigmas) -> Latent:
            if self._unkept is None:
                made = self._model.extend(noisy, sigma, alone, self._cache)
                return shaped(self._model, "extend", made, *noisy.shape)
            pair = torch.cat([self._unkept, noisy], 1)
            level = functional.pad(sigma, (done, 0))
            made = self._model.extend(pair, level, conditioning, self._cache)
            predicted = shaped(self._model, "extend", made, *pair.shape)
            self._cache.keep(done)
            self._unkept = None
            return predicted[:, done:]

        noise = drawn_noise((1, *self._shape), self._generators).to(self._unkept)
        self._unkept = self._model.flow.sample(denoise, noise, noise[:, :0], self._steps)
        return self._unkept
