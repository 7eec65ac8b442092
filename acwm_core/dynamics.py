"""The `DynamicsModel` interface: what predicts latents from latents and actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from acwm_core.conditioner import Conditioning
from acwm_core.errors import RecipeError
from acwm_core.shapes import Latent


class DynamicsModel(nn.Module, ABC):
    """Predicts the latent frames that follow given ones under embedded actions.

    How it does so is its own business: `acwm_core.denoiser.Denoiser` removes noise step by step,
    another may compute the next frame at once. What all share is a training loss, the prediction of
    a clip, and a stream that carries its state from frame to frame.

    Every model takes the keyword argument `latent_channels`, which the framework fills in from the
    codec; its own parameters come after it and are set in the recipe. The latent size h × w and the
    length L are those of the input; a model refuses with a `ShapeError` what it cannot take.

    Attributes:
        width: width D of the conditioner's modulation and tokens.
        layers: number of layers after which the conditioner may act; 0 if it acts through its
            modulation alone.
        heads: attention heads, given to the conditioner.
        causal: whether what it predicts of a latent frame depends on no later one.
        sampling_steps: network evaluations per prediction where nobody asks for another number.
        streams_by_default: whether its stream is what it was trained for, and so how it is rolled
            out unless asked otherwise.
        given_frames: latent frames K of a training clip that are given; the framework sets it.
    """

    width: int
    layers: int
    heads: int
    causal: bool = False
    sampling_steps: int = 1
    streams_by_default: bool = False
    given_frames: int = 1

    @abstractmethod
    def loss(
        self, latents: Latent, conditioning: Conditioning, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Training loss of a batch of clips, a scalar: of what follows `given_frames` frames.

        Args:
            latents: clean latents `[B, L, C, h, w]`, L > `given_frames`.
            conditioning: the embedded actions of the clips.
            generators: a CPU generator per clip; whatever is random comes from it, so that what is
                drawn for a clip depends neither on its neighbours nor on the device.
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
        """The clip that follows the given latent frames.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            conditioning: the embedded actions of the clip.
            frames: length L of the clip, those given included.
            generators: a CPU generator per clip, as in `loss`.
            steps: network evaluations, for a model that has a choice; `sampling_steps` by default.

        Returns:
            `[B, L, C, h, w]`, its first K frames `given`.
        """

    def stream(
        self,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """The same, one latent frame at a time and without end; a causal model may offer it.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            generators: a CPU generator per clip.
            steps: as in `predict`.
            context: latent frames that a frame sees, its own included, at least 2; for a model
                whose memory is bounded so.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame, or was not trained for it.
        """
        raise RecipeError(
            f"{type(self).__name__} keeps nothing of earlier frames, so it cannot be streamed"
        )

    def matrices(self) -> list[nn.Parameter]:
        """The hidden weight matrices, which Muon updates; other parameters get AdamW.

        Muon is meant for those alone: not for what embeds the input or makes the output
        (https://kellerjordan.github.io/posts/muon). By default the weights of linear layers within
        repeated blocks (children of a `ModuleList`).
        """
        return hidden_matrices(self)


class LatentStream(ABC):
    """A prediction under way, with its state, in constant memory."""

    @abstractmethod
    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame, `[B, 1, C, h, w]`.

        Args:
            conditioning: of the last latent frame and the next, the first time of all given ones
                and the next. The embedding of the last may have changed, as a conditioner may look
                one step ahead.
        """


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


def hidden_matrices(module: nn.Module) -> list[nn.Parameter]:
    """The trainable weights of linear layers within `nn.ModuleList`s."""
    found: dict[int, nn.Parameter] = {}
    for blocks in (each for each in module.modules() if isinstance(each, nn.ModuleList)):
        for linear in (each for each in blocks.modules() if isinstance(each, nn.Linear)):
            if linear.weight.requires_grad:
                found[id(linear.weight)] = cast(nn.Parameter, linear.weight)
    return list(found.values())
