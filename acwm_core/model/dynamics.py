"""The interfaces of dynamics models, which objectives train: `Denoiser` and `Predictor`."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Literal, cast

from torch import Generator, Tensor, nn

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Latent, Sigmas

InputKind = Literal["latent", "level"]
"""A further input of a denoiser: latents `[B, L, C, h, w]`, or a number in [0, 1] for each latent
frame `[B, L]`."""


class DynamicsModel(nn.Module, ABC):
    """A network that an objective trains to predict latent frames from embedded actions.

    It is a `Denoiser`, which removes noise step by step, or a `Predictor`, which computes frames
    directly.

    Every model takes the keyword argument `latent_channels`, which the framework fills in from the
    codec. Its own parameters come after it and are set in the recipe. The latent size h × w and the
    length L are those of the input; a model raises `ShapeError` for sizes it does not support.

    A model with layers calls the conditioner before the first one (`Conditioning.inject_input`) and
    after each (`Conditioning.inject`), and continues with the tokens that it returns. Otherwise, a
    conditioner that acts there would fail silently.

    Attributes:
        width: width D of the conditioner's modulation and of the tokens before the first layer.
        layers: number of layers after which the conditioner may act; 0 if it acts only through its
            modulation.
        heads: number of attention heads, passed to the conditioner; divides all `widths`.
        causal: whether the prediction of a latent frame depends on no later frame.
        samples: whether a prediction depends on the clip's noise generator, so that other seeds
            give other futures. Otherwise there is one future for all seeds.
    """

    width: int
    layers: int
    heads: int
    causal: bool = False
    samples: bool = False

    @functools.cached_property
    def widths(self) -> tuple[int, ...]:
        """Width of the tokens after each layer; `width` for all of them unless a model sets it."""
        return (self.width,) * self.layers

    def matrices(self) -> list[nn.Parameter]:
        """The hidden weight matrices, which Muon updates; AdamW updates all other parameters.

        Muon is meant only for these, not for input embeddings or output layers
        (https://kellerjordan.github.io/posts/muon). By default, these are the weights of linear
        layers within repeated blocks (children of a `ModuleList`).
        """
        return hidden_matrices(self)


class Denoiser(DynamicsModel):
    """A network that is evaluated on noisy latents, as often as its objective requires.

    A denoiser that can be built causal or not takes the argument `causal: bool | None = None`. One
    that can take further inputs takes `inputs: Mapping[str, InputKind] | None = None`. If a recipe
    leaves them None, the framework sets what the recipe's objective needs.

    Attributes:
        inputs: the further inputs that `forward` and `extend` take, by name.
    """

    samples = True
    inputs: Mapping[str, InputKind] = {}

    @abstractmethod
    def forward(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, **inputs: Tensor
    ) -> Latent:
        """Evaluate the network once. The objective defines the output, e.g. a velocity.

        Args:
            latents: noisy latents `[B, L, C, h, w]`; those of given frames are clean.
            sigma: noise level of each latent frame `[B, L]`, from 0 (clean) to 1 (noise).
            conditioning: the embedded actions; the model adds `modulation` to its timestep
                embedding, and calls `inject_input` once before its first layer and `inject` once
                after each layer.
            **inputs: all of `self.inputs`. A level is embedded as `sigma` is, and further latents
                as the noisy ones are; a model without any need not take them.

        Returns:
            The prediction, in the shape of `latents`.
        """

    def new_cache(self, context: int) -> Cache:
        """Create an empty cache for `extend`, in which a latent frame sees the last `context` ones.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(
            f"{type(self).__name__} has no cache of earlier frames, so it cannot be streamed"
        )

    def extend(
        self,
        latents: Latent,
        sigma: Sigmas,
        conditioning: Conditioning,
        cache: Cache,
        **inputs: Tensor,
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
            **inputs: as in `forward`, of these n frames.

        Returns:
            The prediction, in the shape of `latents`.
        """
        raise RecipeError(f"{type(self).__name__} has no cache of earlier frames")


class Predictor(DynamicsModel):
    """A network that computes the frames after the given ones directly, without denoising.

    One that samples a future (`samples`) takes the further keyword ``generators`` in `forward`, in
    `stream` and in `predict_states`: one CPU generator per clip, its only source of randomness. All
    three sample the same future.

    One that can learn the agent's states takes the argument ``state_size: int = 0``, their number,
    which the framework fills in, and implements `state_loss`, and `motion_loss` if it can learn how
    actions move the agent without a picture.

    One that draws pictures from states (`follows_states`) gets them in every video frame
    `[B, T, S]`, in `state_loss` and `motion_loss`, and while it is trained, by the further keyword
    ``states: Tensor | None`` of `forward`. Without them it estimates them.

    One that saves work if it need not return all frames (`skips`) takes the further keyword
    ``only: Tensor | None`` in `forward`: for each clip the numbers `[B, N]` of the frames to
    return, counted from the first predicted one.

    One that predicts the scene's states (`predicts_states`) returns them from `predict_states`,
    without drawing a picture.

    Attributes:
        streams: whether it implements `stream`, which is then the default mode of rollouts.
        skips: whether `forward` takes ``only``.
        follows_states: whether `forward` takes ``states``, for every video frame.
        raw_states: whether it takes states as they were recorded, and not scaled to variance 1.
        predicts_states: whether it implements `predict_states`.
    """

    streams: bool = False
    skips: bool = False
    follows_states: bool = False
    raw_states: bool = False
    predicts_states: bool = False

    @abstractmethod
    def forward(self, given: Latent, conditioning: Conditioning, frames: int) -> Latent:
        """Predict the latent frames of a clip that follow the given ones.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            conditioning: the embedded actions of the clip.
            frames: length L of the clip, including the given frames.

        Returns:
            `[B, L − K, C, h, w]`.
        """

    def state_loss(self, batch: Batch) -> Tensor:
        """The loss of its prediction of the agent's `batch.states`, a scalar. Optional.

        States are available in training only; `forward` does not get them.
        """
        raise RecipeError(f"{type(self).__name__} learns no states: leave out data.states")

    def motion_loss(
        self, states: Tensor, conditioning: Conditioning, random: Generator, *, progress: float
    ) -> Tensor:
        """The loss of how actions move the agent, without pictures, a scalar. Optional.

        Args:
            states: of the agent in each latent frame, `[B, L, S]`, scaled as in `Batch.states`.
            conditioning: the embedded actions of the clips.
            random: a CPU generator, the only source of randomness.
            progress: share of the training that is over, 0 to 1, for models that learn from short
                clips first.
        """
        raise RecipeError(
            f"{type(self).__name__} learns no motion without pictures: leave out "
            "training.agent_steps"
        )

    def predict_states(self, given: Latent, conditioning: Conditioning, frames: int) -> Tensor:
        """The states in each video frame after the given ones, `[B, T, S]`. Optional.

        In the recorded units; NaN where unknown.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`, or `[1, K, C, h, w]` if all
                clips have the same start.
            conditioning: the embedded actions of B clips.
            frames: length L of the clips, including the given frames.
        """
        raise RecipeError(f"{type(self).__name__} predicts no states")

    def stream(self, given: Latent, *, context: int) -> LatentStream:
        """Predict one latent frame at a time, without end. Optional, for causal models.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            context: number of latent frames that a frame sees, including itself, at least 2; for
                models whose memory is bounded in this way.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(f"{type(self).__name__} has no `stream`, so it cannot be streamed")


class LatentStream(ABC):
    """A running frame-by-frame prediction, with its state, in constant memory."""

    @abstractmethod
    def advance(self, conditioning: Conditioning) -> Latent:
        """Predict the next latent frame, `[B, 1, C, h, w]`.

        Args:
            conditioning: of the last latent frame and the next one; in the first call, of all
                given frames and the next one. The embedding of the last frame may have changed, as
                a conditioner may look one step ahead.
        """


class Cache(ABC):
    """State that a causal denoiser keeps of earlier latent frames, in constant memory.

    Args:
        context: number of latent frames that a frame sees, including itself; at least 2.

    Attributes:
        frames: number of latent frames cached since the start, even if they left the context.
    """

    def __init__(self, context: int) -> None:
        if context < 2:
            raise RecipeError(f"a context of {context} latent frames remembers nothing: at least 2")
        self.context = context
        self.frames = 0

    @abstractmethod
    def keep(self, frames: int) -> None:
        """Cache the first `frames` frames of the last evaluation as the past of later frames."""


def hidden_matrices(module: nn.Module) -> list[nn.Parameter]:
    """The trainable weights of linear layers within `nn.ModuleList`s."""
    found: dict[int, nn.Parameter] = {}
    for blocks in (each for each in module.modules() if isinstance(each, nn.ModuleList)):
        for linear in (each for each in blocks.modules() if isinstance(each, nn.Linear)):
            if linear.weight.requires_grad:
                found[id(linear.weight)] = cast(nn.Parameter, linear.weight)
    return list(found.values())
