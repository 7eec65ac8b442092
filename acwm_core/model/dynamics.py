"""The `DynamicsModel` interface: predicts latents from latents and actions."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Latent


class DynamicsModel(nn.Module, ABC):
    """Predicts the latent frames that follow given ones, from embedded actions.

    The method is up to the model: a `Denoiser` removes noise step by step, another
    may compute the next frame directly. All have a training loss, the prediction of a clip, and
    optionally a stream that carries its state from frame to frame.

    Every model takes the keyword argument `latent_channels`, which the framework fills in from the
    codec. Its own parameters come after it and are set in the recipe. The latent size h × w and the
    length L are those of the input; a model raises `ShapeError` for sizes it does not support.

    A model with layers calls the conditioner before the first one (`Conditioning.inject_input`) and
    after each (`Conditioning.inject`), and goes on with the tokens that it returns. Otherwise, a
    conditioner that acts there would have no effect, and nobody would be told.

    Attributes:
        width: width D of the conditioner's modulation and of the tokens before the first layer.
        layers: number of layers after which the conditioner may act; 0 if it acts only through its
            modulation.
        heads: number of attention heads, passed to the conditioner; divides all `widths`.
        causal: whether the prediction of a latent frame depends on no later frame.
        sampling_steps: default number of network evaluations per prediction.
        streams_by_default: whether it was trained for its stream, which is then the default mode
            of rollouts.
        given_frames: number K of given latent frames in a training clip; the framework sets it.
    """

    width: int
    layers: int
    heads: int
    causal: bool = False
    sampling_steps: int = 1
    streams_by_default: bool = False
    given_frames: int = 1

    @functools.cached_property
    def widths(self) -> tuple[int, ...]:
        """Width of the tokens after each layer; `width` for all of them unless a model sets it."""
        return (self.width,) * self.layers

    @abstractmethod
    def loss(
        self, latents: Latent, conditioning: Conditioning, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Training loss of a batch of clips, a scalar, over the frames after the `given_frames`.

        Args:
            latents: clean latents `[B, L, C, h, w]`, L > `given_frames`.
            conditioning: the embedded actions of the clips.
            generators: one CPU generator per clip. All random numbers of a clip come from it, so
                they depend neither on the other clips of the batch nor on the device.
        """

    @abstractmethod
    def predict(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[torch.Generator],
        steps: int | None = None,
    ) -> Latent:
        """Predict a clip that starts with the given latent frames.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            conditioning: the embedded actions of the clip.
            frames: length L of the clip, including the given frames.
            generators: one CPU generator per clip, as in `loss`.
            steps: number of network evaluations, if the model has a choice; `sampling_steps` by
                default.

        Returns:
            `[B, L, C, h, w]`; its first K frames are `given`.
        """

    def stream(
        self,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """Predict one latent frame at a time, without end. Optional, for causal models.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            generators: one CPU generator per clip.
            steps: as in `predict`.
            context: number of latent frames that a frame sees, including itself, at least 2; for
                models whose memory is bounded in this way.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame, or was not trained for it.
        """
        raise RecipeError(
            f"{type(self).__name__} has no cache of earlier frames, so it cannot be streamed"
        )

    def matrices(self) -> list[nn.Parameter]:
        """The hidden weight matrices, which Muon updates; AdamW updates all other parameters.

        Muon is meant only for these, not for input embeddings or output layers
        (https://kellerjordan.github.io/posts/muon). By default, these are the weights of linear
        layers within repeated blocks (children of a `ModuleList`).
        """
        return hidden_matrices(self)


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
    """State that a causal model keeps of earlier latent frames, in constant memory.

    Args:
        context: number of latent frames that a frame sees, including itself; at least 2.

    Attributes:
        frames: number of latent frames cached since the start, even if they left the context.

    Raises:
        RecipeError: the context is below 2, which would remember nothing.
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
