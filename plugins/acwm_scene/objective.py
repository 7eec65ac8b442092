"""How a scene model learns: to read what is there, to move it, and to draw it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.dynamics import DynamicsModel, Predictor
from acwm_core.model.objectives.objective import Objective, TrainingClips
from acwm_core.model.objectives.regression import Regression, frames_of
from acwm_scene.motion_training import learn_motion
from acwm_scene.point_training import learn_points, states_with_points
from acwm_scene.scene import SceneDynamics

READ_FRAMES = 4
"""Frames of each clip from which it learns to read, the first one among them."""


class SceneObjective(Regression):
    """Reading and drawing are learnt from pictures, and motion from states and actions alone.

    A step on pictures draws what is truly there (teacher forcing), so that what is drawn does not
    blur with what cannot be foretold; by squared error, as `regression` does. How things move is
    learnt before the first such step, without pictures, where a step costs little and sees many
    clips; or along with them.

    Args:
        state_weight: weight of the error of what is read from frames (and of how it is moved, if
            `motion_steps` is 0) beside that of the pictures.
        frames: number of latent frames of each clip, drawn at random, that a step draws; None for
            all.
        point_steps: steps that learn what the points of a scene with `model.points` are, before all
            others; what finds them then stays as it is.
        motion_steps: steps that learn how things move, before the first one on pictures; what they
            learnt then stays as it is. 0 to learn it along with the pictures.

    Raises:
        RecipeError: no frames, or a negative number of steps.
    """

    trains = SceneDynamics
    learns_states = True

    def __init__(
        self,
        *,
        state_weight: float = 0.3,
        frames: int | None = None,
        motion_steps: int = 0,
        point_steps: int = 1000,
    ) -> None:
        super().__init__(frames=frames)
        for name, steps in (("motion_steps", motion_steps), ("point_steps", point_steps)):
            if steps < 0:
                raise RecipeError(f"objective.{name} is {steps}; it must be 0 or more")
        self.state_weight, self.motion_steps = state_weight, motion_steps
        self.point_steps = point_steps
        # Pictures are drawn of true states, whatever the actions; only motion learns from these.
        self.weighs_frames = motion_steps > 0

    def check_model(self, model: DynamicsModel) -> None:
        """Refuse what is no scene; a scene may draw futures, as its motion learns by them."""
        Objective.check_model(self, model)

    def prepare(self, model: Predictor, clips: TrainingClips, *, resumed: bool) -> None:
        """Take the scale of the states unless the weights have one, and learn the motion.

        Before, learn what the points of a scene are that nobody declared.
        """
        assert isinstance(model, SceneDynamics)
        model.prepare(*clips.state_scale())
        if model.points is not None:
            learn_points(model, clips, 0 if resumed else self.point_steps)
        if self.motion_steps:
            states = clips.states if resumed else states_with_points(model, clips)
            learn_motion(model, clips, states, 0 if resumed else self.motion_steps)

    def loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """The error of the drawn latents and of what is read; see `Objective.loss`.

        Without states, as in validation, the error of what it predicts by itself.
        """
        assert isinstance(model, SceneDynamics)
        states = batch.states
        if states is None:
            if model.state_size or not model.training:
                return super().loss(model, batch, known)
            states = batch.latents.new_zeros(
                len(batch.latents), 1 + (batch.latents.shape[1] - 1) * model.stride, 0
            )
        frames = batch.latents.shape[1]
        numbers = self.compared_frames(model, batch, known)
        if numbers is None:
            count = frames - known
            numbers = torch.arange(count, device=batch.latents.device).expand(
                len(batch.latents), -1
            )
        given = torch.arange(known, device=numbers.device).expand(len(numbers), -1)
        read_frames = torch.cat([given, known + numbers], 1) if self.motion_steps else None
        states = model.with_points(states, batch.latents, read_frames)
        predicted = model.draw_true(batch.latents[:, :known], states, numbers)
        pictures = functional.mse_loss(predicted.float(), frames_of(batch, known, numbers).float())
        read = batch.random_frames(min(READ_FRAMES, frames) - 1, frames - 1) + 1
        read = torch.cat([torch.zeros_like(read[:, :1]), read], 1)
        others = model.reading_loss(batch.latents, states, read)
        if not self.motion_steps:
            random = batch.generators[0]
            others = others + model.motion_loss(
                states.detach(), batch.conditioning, random, progress=1.0
            )
        return pictures + self.state_weight * others

    def example_model(self, latent_channels: int) -> SceneDynamics:
        """A small scene of four values."""
        return SceneDynamics(
            latent_channels=latent_channels, state_size=4, channels=16, width=4, blocks=1
        )
