"""The training clips, as an objective prepares a model with them."""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.shapes import Latent
from acwm_core.model.world_model import WorldModel
from acwm_core.training.data import ClipData


class PreparationClips:
    """`acwm_core.model.objectives.objective.TrainingClips` of a run.

    Args:
        world_model: the model of the run; it is moved to the device that trains when it is needed.
        data: set up.
        seed: of the run.
    """

    def __init__(self, world_model: WorldModel, data: ClipData, seed: int) -> None:
        self._world_model, self._data = world_model, data
        self.seed = seed

    @property
    def shows_progress(self) -> bool:
        """Whether this is the process that shows how far training is."""
        return self._data.is_first_process

    @property
    def states(self) -> Tensor:
        """The states of the clips of the commonest length, `[N, T, S]`."""
        return self._inputs["states"]

    @property
    def weights(self) -> Tensor | None:
        """The weights of the frames of these clips; see `TrainingClips.weights`."""
        return self._inputs.get("weights")

    def latents(self, rows: Tensor) -> Latent:
        """The latents of some clips; see `TrainingClips.latents`."""
        clips, device = self._data.training_clips, self._data.device
        batch = clips.batch(self._alike[rows.cpu().numpy()].tolist())
        if "latents" in batch:
            return batch["latents"].to(device)
        with torch.no_grad():
            return self._world_model.encode(batch["video"].to(device) / 255)

    def state_scale(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the states; see `TrainingClips.state_scale`."""
        mean, std = self._data.state_scale()
        device = self._data.device
        return mean.to(device), std.to(device)

    def conditioning(self, rows: Tensor) -> Conditioning:
        """The embedded actions of some clips; see `TrainingClips.conditioning`."""
        actions = self._inputs["actions"][rows]
        frames = self._world_model.codec.latent_frames(actions.shape[1])
        return self._world_model.condition(actions, frames)

    def conditioner_parameters(self) -> list[nn.Parameter]:
        """The weights that embed actions."""
        return [*self._world_model.conditioner.parameters()]

    @functools.cached_property
    def _inputs(self) -> dict[str, Tensor]:
        device = self._data.device
        self._world_model.to(device)
        inputs = self._data.training_clips.inputs(self._alike.tolist())
        inputs.setdefault("states", inputs["actions"][..., :0])
        return {name: values.to(device) for name, values in inputs.items()}

    @functools.cached_property
    def _alike(self) -> NDArray[np.int64]:
        """Numbers of the clips of the commonest length."""
        every = self._data.training_clips.lengths
        lengths, counts = np.unique(every, return_counts=True)
        return np.flatnonzero(every == lengths[counts.argmax()])
