"""The `CheckpointImporter` interface: other programs' training checkpoints, read as ours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from acwm_core.conditioner import Conditioner
from acwm_core.dynamics import DynamicsModel

State = dict[str, Tensor]
"""What `load_state_dict` takes."""


@dataclass(frozen=True)
class ForeignModel:
    """A world model found in a checkpoint.

    Attributes:
        sections: of a recipe, as the weights were trained: at least `model`, `conditioner` and
            `codec`.
        latent_channels: channels C of the codec's latents.
        temporal_stride: actions per latent frame.
        action_size: dimensions A of an action.
        step: optimiser steps behind the weights; 0 if the checkpoint does not say.
        convert: the states of the model and the conditioner that the sections name, which are
            handed to it (built on the meta device). Raises `CheckpointError` with the name of a
            tensor that is missing, unexpected or of another shape.
        untold: parameters that must be set by an override, because the weights don't tell them: the
            reason by parameter, ``{"model.heads": "…"}``.
        codec_weights: the codec's own, if the checkpoint has them, as its parameter `weights` takes
            them from a ``.safetensors`` file.
        notes: sentences for people.
    """

    sections: Mapping[str, Any]
    latent_channels: int
    temporal_stride: int
    action_size: int
    step: int
    convert: Callable[[DynamicsModel, Conditioner], tuple[State, State]]
    untold: Mapping[str, str] = field(default_factory=dict[str, str])
    codec_weights: Mapping[str, Tensor] = field(default_factory=dict[str, Tensor])
    notes: tuple[str, ...] = ()


class CheckpointImporter(ABC):
    """Knows one format of checkpoints by their content. Constructed without arguments."""

    @abstractmethod
    def read(self, content: Mapping[str, Any]) -> ForeignModel | None:
        """What a file holds, or None if it is of another format.

        Args:
            content: plain Python values and CPU tensors, which may lie on disk until they are
                used: what ``torch.load`` returns of a file in which nothing was executed, or the
                tensors of a ``.safetensors`` file by name.

        Raises:
            CheckpointError: it is of this format, but something is missing or wrong.
        """

    @abstractmethod
    def example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """A small content of this format with random weights, and overrides for its import.

        The conformance suite imports it, whole and damaged.
        """
