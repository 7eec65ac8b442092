"""The `Objective` interface: how a model learns from clips, and how it then predicts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Denoiser, DynamicsModel, InputKind, LatentStream
from acwm_core.model.shapes import Latent

ModelT = TypeVar("ModelT", bound=DynamicsModel)


class TrainingClips(Protocol):
    """The clips of the commonest length that a run trains on; see `Objective.prepare`.

    Attributes:
        seed: of the run.
        shows_progress: whether this process shows how far it is.
        states: what to learn of the scene, as it was recorded, `[N, T, S]` on the device that
            trains; S is 0 if there is nothing.
        weights: how much the frame counts that each action leads to, `[N, T]`, 0 or more; None if
            all count alike.
    """

    @property
    def seed(self) -> int: ...  # noqa: D102

    @property
    def shows_progress(self) -> bool: ...  # noqa: D102

    @property
    def states(self) -> Tensor: ...  # noqa: D102

    @property
    def weights(self) -> Tensor | None: ...  # noqa: D102

    def state_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the states over all training episodes, `[S]` each.

        Of a value that never changes, the deviation is 1.
        """
        ...

    def latents(self, rows: Tensor) -> Latent:
        """The latents of some of these N clips, `[B, L, C, h, w]` on the device that trains."""
        ...

    def conditioning(self, rows: Tensor) -> Conditioning:
        """The embedded actions of some of these N clips, with a gradient."""
        ...

    def conditioner_parameters(self) -> list[nn.Parameter]:
        """The weights that embed actions."""
        ...


class Objective(ABC, Generic[ModelT]):
    """How a model learns from clips, and how it predicts.

    An objective has neither weights nor state: its parameters come from the recipe, and the model
    is an argument of every method. Latents, actions and noise are those of whole clips; no method
    sees pixels.

    Random numbers of a clip come from the clip's own generator, on the CPU, so that they depend
    neither on the other clips of the batch nor on the device.

    Attributes:
        trains: the class of the models that it trains, `Denoiser` or `Predictor`.
        causal: whether the model has to be causal in time.
        inputs: further latents or levels that it gives a denoiser, by name (`Denoiser.inputs`).
        steps: default number of network evaluations per prediction; None if there is no choice.
        learns_states: whether it trains on states of the scene, too; see `Batch.states`.
        weighs_frames: whether its loss heeds `Batch.weights`.
    """

    trains: type[ModelT]
    causal: bool = False
    inputs: Mapping[str, InputKind] = {}
    steps: int | None = None
    learns_states: bool = False
    weighs_frames: bool = False

    def prepare(self, model: ModelT, clips: TrainingClips, *, resumed: bool) -> None:
        """Prepare a model before the first step of a training. Optional.

        For what is cheap without pictures, or needs few of them: to measure the data, to teach a
        part of the model, to freeze it.
        It is called before the optimiser is built, in all processes alike.

        Args:
            model: the model to train; its weights are new, or those of `training.init_from`.
            clips: what it will be trained on.
            resumed: whether a checkpoint will replace the weights right after; only what is no
                weight is then to be prepared.
        """

    def example_model(self, latent_channels: int) -> ModelT | None:
        """A small model that it trains, for the conformance checks; None for one of theirs."""
        return None

    @abstractmethod
    def loss(self, model: ModelT, batch: Batch, known: int) -> Tensor:
        """Training loss of a batch of clips, a scalar, over the frames after the given ones.

        Args:
            model: the model to train.
            batch: the clips, of L > `known` latent frames.
            known: number of latent frames that are given.
        """

    @abstractmethod
    def predict(self, model: ModelT, given: Batch, frames: int, steps: int | None = None) -> Latent:
        """Predict a clip that starts with the given latent frames.

        Args:
            model: a trained model.
            given: the first K ≥ 1 latent frames of clips.
            frames: length L of the clips, including the given frames.
            steps: number of network evaluations, if there is a choice; `steps` of the objective by
                default.

        Returns:
            `[B, L, C, h, w]`; its first K frames are `given`.
        """

    def predict_frames(
        self,
        model: ModelT,
        given: Batch,
        frames: int,
        only: Sequence[int],
        steps: int | None = None,
    ) -> Latent:
        """The predicted frames of these numbers alone, `[B, len(only), C, h, w]`; see `predict`.

        A model that can saves the work for others; see `Predictor.predict_frames`.

        Args:
            only: K for the first frame that is predicted, up to L - 1.
        """
        return self.predict(model, given, frames, steps)[:, list(only)]

    def stream(
        self,
        model: ModelT,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """Predict one latent frame at a time, without end. Optional.

        Args:
            model: a trained model, causal in time.
            given: the first K ≥ 1 latent frames, `[B, K, C, h, w]`.
            generators: one CPU generator per clip.
            steps: as in `predict`.
            context: number of latent frames that a frame sees, including itself, at least 2; for
                models whose memory is bounded in this way.

        Raises:
            RecipeError: models with this objective, or this model, cannot be streamed.
        """
        raise RecipeError(
            f"a model trained with {type(self).__name__} cannot be streamed: train with "
            "objective=diffusion_forcing or next_frame"
        )

    def streams_by_default(self, model: ModelT) -> bool:
        """Whether a model was trained for its stream, which is then the default of rollouts."""
        return False

    def check_model(self, model: DynamicsModel) -> None:
        """Refuse a model that this objective cannot train.

        Raises:
            RecipeError: says what the model lacks, and what to choose instead.
        """
        of, name = type(model).__name__, type(self).__name__
        if not isinstance(model, self.trains):
            kind, other = (
                ("removes noise step by step", "objective=regression")
                if issubclass(self.trains, Denoiser)
                else ("predicts frames at once", "objective=diffusion_forcing")
            )
            raise RecipeError(
                f"{name} needs a model that {kind} (a {self.trains.__name__}), which {of} is not: "
                f"choose another model or {other}"
            )
        missing = {*self.inputs} - {*(model.inputs if isinstance(model, Denoiser) else ())}
        if missing:
            raise RecipeError(
                f"{name} needs a model with the further inputs {', '.join(self.inputs)}, which "
                f"{of} does not take: choose another model or objective=diffusion_forcing"
            )
        if self.causal and not model.causal:
            raise RecipeError(
                f"{name} needs a model that is causal in time, but {of} with these parameters is "
                "not: set model.causal=true if it has that parameter, or objective=full_sequence"
            )
