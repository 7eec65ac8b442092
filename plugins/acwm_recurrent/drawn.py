"""A predictor for scenes that their states tell all of: it moves states, and draws the picture."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.objective import Batch, drawn_noise, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.scene import SceneModel
from acwm_recurrent.states import StateDrawing, StateMotion, StateSight

READ_FRAMES = 2
"""Frames of each clip from which it learns to read states, the first one among them."""

START_NOISE = 0.03
"""Noise on the true states that motion is learned from, in standard deviations."""

HORIZONS = ((0.35, 8), (0.65, 20), (0.9, 64))
"""Until which share of the training motion is learned from windows of so many video frames: the
same error in a tenth of the time. Then from whole clips, in which errors add up."""

MOVED_FRAMES = 128 * 64
"""Most video frames that a step of motion moves, of all its clips: of long ones it takes fewer."""

SHOWN_NOISE = 0.02
"""Noise on the true states that drawing is learned from, beside the error of reading."""


class Scene(NamedTuple):
    """What is passed from one latent frame to the next.

    Attributes:
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
        canvas: what all frames are drawn on, see `StateDrawing.canvas`.
        given: states in the given frame, `[B, S]`.
        states: in the last video frame, `[B, S]`.
        hidden: what moves them, see `StateMotion`.
    """

    base: Tensor
    canvas: Tensor
    given: Tensor
    states: Tensor
    hidden: Tensor


class DrawnStates(SceneModel[Scene, Tensor]):
    """Reads the states of the scene from the given frame, moves them, and draws them.

    It is for a camera that stands still, and for scenes of which `data.states` tell all that moves:
    a robot's joints, the poses of what it holds. What they do not tell stays as the given frame
    shows it. `training.agent_steps` teaches how states move, without pictures.

    Args:
        latent_channels: channels C of the codec.
        state_size: number of values S of the states.
        following: how many of the states, the last ones, follow from the others in every frame, as
            a hand's place does from the angles of joints. Their errors do not add up.
        temporal_stride: video frames per latent frame of the codec.
        channels: size of the grid that is drawn on.
        width: size of the conditioner's modulation, and of what the blocks are told.
        blocks: number of residual blocks that draw.

    Raises:
        RecipeError: a size below 1, or no states that others could follow from.
    """

    name = "drawn_states"

    def __init__(
        self,
        *,
        latent_channels: int,
        state_size: int = 1,
        following: int = 0,
        temporal_stride: int = 4,
        channels: int = 96,
        width: int = 192,
        blocks: int = 4,
    ) -> None:
        super().__init__(latent_channels, temporal_stride, width)
        if min(channels, width, blocks) < 1:
            raise RecipeError("channels, width and blocks of drawn_states must be at least 1")
        if not 0 <= following < state_size:
            raise RecipeError(
                f"model.following={following} of the {state_size} values of data.states follow "
                f"from the others: give 0 to {state_size - 1}"
            )
        self.sight = StateSight(latent_channels, state_size, channels)
        self.motion = StateMotion(state_size, following, width, temporal_stride)
        self.drawing = StateDrawing(
            latent_channels,
            state_size,
            stride=temporal_stride,
            channels=channels,
            width=width,
            blocks=blocks,
        )

    def start(self, given: Latent) -> Scene:
        """What is known after the last of the given frames; see `SceneModel.start`."""
        base = self.checked(given)[:, -1]
        return self._begun(base, self.sight(base))

    def step(self, scene: Scene, told: Tensor) -> tuple[Scene, Tensor]:
        """One latent frame later, and the states in its video frames, `[B, stride, S]`."""
        states, hidden, passed = scene.states, scene.hidden, list[Tensor]()
        with torch.autocast(told.device.type, enabled=False):
            for action in told.unbind(1):
                states, hidden = self.motion(action, states, hidden)
                passed.insert(0, states)
        return scene._replace(states=states, hidden=hidden), torch.stack(passed, 1)

    def state_loss(self, batch: Batch) -> Tensor:
        """The error of the states that it reads from frames, and of how it moves them.

        How they move is left out if `training.agent_steps` taught it.
        """
        assert batch.states is not None
        frames = batch.latents.shape[1]
        picked = batch.picked(min(READ_FRAMES, frames) - 1, frames - 1) + 1
        picked = torch.cat([torch.zeros_like(picked[:, :1]), picked], 1)
        looked = batch.latents.take_along_dim(picked[..., None, None, None], 1).flatten(0, 1)
        true = batch.states.take_along_dim(self.stride * picked[..., None], 1).flatten(0, 1)
        loss = functional.smooth_l1_loss(self.sight(looked), true, beta=0.1)
        if not self.motion.gru.weight_hh.requires_grad:
            return loss
        noise = sent(drawn_noise(true.shape[1:], batch.generators), true)
        frames = batch.states.shape[1] - 1
        moved = self._motion_loss(batch.states, batch.conditioning, noise, first=0, frames=frames)
        return loss + moved

    def motion_loss(
        self,
        states: Tensor,
        conditioning: Conditioning,
        random: torch.Generator,
        *,
        progress: float,
    ) -> Tensor:
        """The error of the states that actions lead to from true ones, which are a little off."""
        noise = sent(torch.randn(states[:, 0].shape, generator=random), states)
        last = states.shape[1] - 1
        frames = next((size for until, size in HORIZONS if progress < until and size < last), last)
        first = int(torch.randint(last - frames + 1, (), generator=random))
        return self._motion_loss(states, conditioning, noise, first=first, frames=frames)

    def told(self, embedded: Tensor) -> Tensor:
        """Embedded actions by video frames; see `StateMotion.told`."""
        return self.motion.told(embedded)

    def drawn(self, scene: Scene, shown: Tensor) -> Tensor:
        """The latent frame of states `[B, stride, S]`, the last one first."""
        return scene.base + self.drawing(scene.canvas, scene.given, shown)

    def true_course(self, given: Latent, states: Tensor) -> tuple[Scene, Tensor]:
        """The true states from the last given frame on, a little off while it learns."""
        course = states[:, (given.shape[1] - 1) * self.stride :]
        if self.training:
            course = self._as_read(given[:, -1], course)
            noise = SHOWN_NOISE * torch.randn_like(course[:, :2])
            first, later = course[:, :1] + noise[:, :1], course[:, 1:] + noise[:, 1:]
            course = torch.cat([first, later], 1)
        return self._begun(given[:, -1], course[:, 0]), course

    def joined(self, scene: Scene, passed: list[Tensor]) -> Tensor:
        """The states in all video frames from that of the scene on, `[B, 1 + T, S]`."""
        return torch.cat([scene.states[:, None], *(each.flip(1) for each in passed)], 1)

    def drawn_course(self, scene: Scene, course: Tensor, numbers: Tensor) -> Latent:
        """The latent frames with these numbers; see `SceneModel.drawn_course`."""
        rows = numbers[..., None] * self.stride - torch.arange(self.stride, device=numbers.device)
        shown = course.take_along_dim(rows.flatten(1)[..., None], 1).unflatten(1, rows.shape[1:])
        scenes = Scene(*(each.repeat_interleave(numbers.shape[1], 0) for each in scene))
        return self.drawn(scenes, shown.flatten(0, 1)).unflatten(0, numbers.shape)

    def tensors(self, scene: Scene) -> tuple[Tensor, ...]:
        """The scene as tensors."""
        return tuple(scene)

    def scene(self, state: tuple[Tensor, ...]) -> Scene:
        """The inverse of `tensors`."""
        return Scene(*state)

    def _begun(self, base: Tensor, states: Tensor) -> Scene:
        with torch.autocast(base.device.type, enabled=False):
            hidden = self.motion.begin(states)
        return Scene(base, self.drawing.canvas(base, states), states, states, hidden)

    @torch.no_grad()
    def _as_read(self, base: Tensor, course: Tensor) -> Tensor:
        """True states `[B, T, S]`, all along as wrong as they are read from the first frame."""
        wrong = (self.sight(base) - course[:, 0])[:, None]
        with torch.autocast(base.device.type, enabled=False):
            return self.motion.displaced(course, wrong)

    def _motion_loss(
        self, true: Tensor, conditioning: Conditioning, noise: Tensor, *, first: int, frames: int
    ) -> Tensor:
        """The error in so many video frames after the first, from a start that is a little off."""
        with torch.autocast(true.device.type, enabled=False):
            true, noise = (each[: max(1, MOVED_FRAMES // frames)] for each in (true, noise))
            told = self.told_of(conditioning)[: len(true), self.stride + first :]
            states, passed = true[:, first] + START_NOISE * noise, list[Tensor]()
            hidden = self.motion.begin(states)
            for action in told[:, :frames].unbind(1):
                states, hidden = self.motion(action, states, hidden)
                passed.append(states)
            # By the distance and not its square: what a missed grasp or a collision sends
            # elsewhere would outweigh all others.
            later = true[:, first + 1 : first + 1 + frames]
            return functional.smooth_l1_loss(torch.stack(passed, 1), later, beta=0.05)
