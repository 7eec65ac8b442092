"""The interfaces of dynamics models, which objectives train: `Denoiser` and `Predictor`."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, cast

from torch import Generator, Tensor, nn

from acwm_core.env.card import EnvironmentCard
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Latent, Sigmas

InputKind = Literal["latent", "level"]
"""A further input of a denoiser: latents `[B, L, C, h, w]`, or a number in [0, 1] for each latent
frame `[B, L]`."""


class ModelInputs(NamedTuple):
    """What a model is built for.

    Attributes:
        latent_channels: channels C of the codec's latents.
        temporal_stride: video frames per latent frame of the codec.
        environment: the card of the environment that the data shows; None if it is unknown, as for
            a checkpoint of another program.
        states: names of the fields of its state to learn, in their order (`data.states`).
    """

    latent_channels: int
    temporal_stride: int
    environment: EnvironmentCard | None = None
    states: tuple[str, ...] = ()


class Keypoints(NamedTuple):
    """Where a model sees N things in the picture, and what they look like to it.

    Attributes:
        values: in L latent frames, `[B, L, N, D]`: the place, right and down, each from -1 to 1 in
            the picture, and then D − 2 features of the model's own; NaN where it sees none.
        weights: how much the picture changes with each number, `[N, D]`; the unit is the model's.
        shares: how much the picture changes with all that is usual of a keypoint, as a share of the
            one that counts most, `[N]`, 0 to 1.
    """

    values: Tensor
    weights: Tensor
    shares: Tensor


class DynamicsModel(nn.Module, ABC):
    """A network that an objective trains to predict latent frames from embedded actions.

    It is a `Denoiser`, which removes noise step by step, or a `Predictor`, which computes frames
    directly.

    Every model takes the keyword argument `latent_channels`, which follows from the codec, and what
    else its `fitted` takes from the data. Its own parameters come after these and are set in the
    recipe. The latent size h × w and the length L are those of the input; a model raises
    `ShapeError` for sizes it does not support.

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
        fitted_parameters: names of what `fitted` returns beside `latent_channels`.
    """

    width: int
    layers: int
    heads: int
    causal: bool = False
    samples: bool = False
    fitted_parameters: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def fitted(cls, data: ModelInputs) -> dict[str, Any]:
        """The constructor's arguments that follow from the codec and the data.

        Raises:
            RecipeError: a model of this kind cannot learn from such data.
        """
        return {"latent_channels": data.latent_channels}

    @classmethod
    def default_states(
        cls, environment: EnvironmentCard, changing: Collection[str], **parameters: Any
    ) -> tuple[str, ...]:
        """The fields of the state to learn where a recipe names none; none by default.

        Args:
            environment: the card of the environment that the data shows.
            changing: names of the fields that change within episodes.
            **parameters: of the model, as the recipe sets them.
        """
        return ()

    def upgrade(self, weights: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weights that an earlier version of the model saved, under the names that it has now.

        Args:
            weights: by name, as in the model's state dict; they need not be of an earlier version.

        Raises:
            RecipeError: this version cannot use them.
        """
        return weights

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

    All methods take ``generators``, one CPU generator per clip: the only source of randomness of a
    model that draws a future (`samples`). All draw alike, so that the future stays the same one.
    Other models leave them unused.

    Only `forward` is required. The other methods are further abilities.

    Attributes:
        keypoint_names: the things that `read_keypoints` and `predict_keypoints` see, in their
            order; none if the model has no such ability.
    """

    keypoint_names: tuple[str, ...] = ()

    @abstractmethod
    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Predict the latent frames of a clip that follow the given ones.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            conditioning: the embedded actions of the clip.
            frames: length L of the clip, including the given frames.
            generators: one per clip; may be empty if the model does not draw.

        Returns:
            `[B, L − K, C, h, w]`.
        """

    def predict_frames(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        numbers: Tensor,
        generators: Sequence[Generator] = (),
    ) -> Latent:
        """Predict some of these frames; a model that can save the work for the others overrides it.

        Args:
            given, conditioning, frames, generators: as in `forward`.
            numbers: for each clip the frames to return, counted from the first predicted one,
                `[B, N]`.

        Returns:
            `[B, N, C, h, w]`.
        """
        whole = self(given, conditioning, frames, generators)
        return whole.take_along_dim(numbers[..., None, None, None], 1)

    def predict_states(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Tensor:
        """The states in each video frame after the given ones, `[B, T, S]`. Optional.

        In the recorded units; NaN where unknown.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`, or `[1, K, C, h, w]` if all
                clips have the same start.
            conditioning: the embedded actions of B clips.
            frames: length L of the clips, including the given frames.
            generators: as in `forward`.

        Raises:
            RecipeError: the model predicts no states.
        """
        raise RecipeError(f"{type(self).__name__} predicts no states")

    def read_keypoints(self, latents: Latent) -> Keypoints:
        """Where it sees things in latent frames `[B, L, C, h, w]`, each by itself. Optional.

        Raises:
            RecipeError: the model sees no keypoints.
        """
        raise RecipeError(f"{type(self).__name__} sees no keypoints")

    def predict_keypoints(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[Generator] = (),
    ) -> Keypoints:
        """Where it expects them in the L − K latent frames after the given ones. Optional.

        The arguments are those of `predict_states`.

        Raises:
            RecipeError: the model sees no keypoints.
        """
        raise RecipeError(f"{type(self).__name__} sees no keypoints")

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[Generator] = ()
    ) -> LatentStream:
        """Predict one latent frame at a time, without end. Optional, for causal models.

        A model that implements it is streamed by default.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            context: number of latent frames that a frame sees, including itself, at least 2; for
                models whose memory is bounded in this way.
            generators: as in `forward`.

        Raises:
            RecipeError: the model cannot be evaluated frame by frame.
        """
        raise RecipeError(f"{type(self).__name__} has no `stream`, so it cannot be streamed")

    def carry_states(self, given: Latent, generators: Sequence[Generator] = ()) -> CarriedStates:
        """Predict states one latent frame at a time, without end and without pictures. Optional.

        The states are those of `predict_states`.

        Args:
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            generators: as in `forward`.

        Raises:
            RecipeError: the model does not carry states.
        """
        raise RecipeError(f"{type(self).__name__} carries no states from frame to frame")

    def implements(
        self, method: Literal["predict_frames", "predict_states", "stream", "carry_states"]
    ) -> bool:
        """Whether the model has one of the optional abilities."""
        return getattr(type(self), method) is not getattr(Predictor, method)


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

    def keypoints(self) -> Keypoints | None:
        """The things that `move_keypoint` can move, as they are now: L is 1. Optional; else None.

        They may be fewer than those of `Predictor.keypoint_names`.
        """
        return None

    def move_keypoint(self, number: int, place: Tensor) -> None:
        """Move a thing to another place in the picture, from where it continues. Optional.

        Args:
            number: of the keypoint in `keypoints`.
            place: right and down, `[2]`, each from -1 to 1.

        Raises:
            RecipeError: things of this model cannot be moved.
        """
        raise RecipeError(f"{type(self).__name__} cannot move things")


class CarriedStates(ABC):
    """The states of B scenes side by side, which actions move, in constant memory.

    Scenes do not depend on each other, and may have begun at different times.
    """

    @property
    @abstractmethod
    def current(self) -> Tensor:
        """The states in the last video frame, `[B, S]`, as `predict_states` returns them."""

    @abstractmethod
    def advance(self, conditioning: Conditioning) -> Tensor:
        """The states in the video frames of the next latent frame, `[B, stride, S]`.

        Args:
            conditioning: of the last latent frame and the next one, of B scenes.
        """

    @abstractmethod
    def picked(self, rows: Tensor) -> CarriedStates:
        """A copy of some of the scenes, by their numbers `[N]`, each as often as it is named."""

    @abstractmethod
    def put(self, rows: Tensor, others: CarriedStates) -> None:
        """Replace the scenes of these numbers `[N]` by the N scenes of others."""

    def only(self, columns: Collection[int]) -> CarriedStates:
        """The same scenes for who needs these of the S values alone: the others may become NaN.

        A model that moves some things whatever the others do saves the work of the others.
        """
        return self


class Cache(ABC):
    """State that a causal denoiser keeps of earlier latent frames, in constant memory.

    Args:
        context: number of latent frames that a frame sees, including itself; at least 2.

    Attributes:
        frames: number of latent frames cached since the start, even if they left the context.
    """

    def __init__(self, context: int) -> None:
        if context < 2:
            raise RecipeError(
                f"a context of {context} latent frames remembers nothing: give at least 2"
            )
        self.context = context
        self.frames = 0

    @abstractmethod
    def keep(self, frames: int) -> None:
        """Cache the first `frames` frames of the last evaluation as the past of later frames."""


def hidden_matrices(module: nn.Module) -> list[nn.Parameter]:
    """The trainable weights of linear layers within `nn.ModuleList`s."""
    weights: dict[int, nn.Parameter] = {}
    for blocks in (part for part in module.modules() if isinstance(part, nn.ModuleList)):
        for linear in (part for part in blocks.modules() if isinstance(part, nn.Linear)):
            if linear.weight.requires_grad:
                weights[id(linear.weight)] = cast(nn.Parameter, linear.weight)
    return list(weights.values())
