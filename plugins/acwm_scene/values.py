"""Values of a scene, such as the joints of a robot and the poses of what it holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from acwm_core.model.batch import to_device
from acwm_scene.declared import GroupSpec
from acwm_scene.group import SteppedGroup, energy_score
from acwm_scene.value_layers import ValueMotion, ValuePainter, ValueSight

START_NOISE = 0.03
"""Noise on the true values that motion is learned from, in standard deviations."""

HORIZONS = ((0.35, 8), (0.65, 20), (0.9, 64))
"""Until which share of the training motion is learned from windows of so many video frames: the
same error in a tenth of the time. Then from whole clips, in which errors add up."""

MOVED_FRAMES = 128 * 64
"""Most video frames that a step of motion moves, of all its clips: of long ones it takes fewer."""

SHOWN_NOISE = 0.02
"""Noise on the true values that drawing is learned from, beside the error of reading."""


class Values(NamedTuple):
    """The state of values in a video frame.

    Attributes:
        values: standardised, `[B, V]`.
        hidden: what moves them, `[B, HIDDEN]`.
        chance: numbers that this future depends on, `[B, noise]`, of a model that draws.
    """

    values: Tensor
    hidden: Tensor
    chance: tuple[Tensor, ...] = ()


class ValueGroup(SteppedGroup):
    """Values that tell all that moves, with a unit of one standard deviation each.

    An angle is its cosine and sine, so that it may wrap. The last of the values may follow from the
    others in every frame, as a hand's place does from the angles of joints; then their errors do
    not add up.

    Args:
        spec: how many there are, which are angles, and how many follow.
        latent_channels: channels C of the codec.
        stride: video frames per latent frame.
        channels: size of the grid that is drawn on.
        width: size of the conditioner's modulation.
        noise: numbers that a draw depends on; 0 for one future.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        spec: GroupSpec,
        *,
        latent_channels: int,
        stride: int,
        channels: int,
        width: int,
        noise: int = 0,
        **_: object,
    ) -> None:
        super().__init__()
        self.stride, self.noise = stride, noise
        recorded = len(spec.columns)
        angles = [number in spec.angles for number in range(recorded)]
        self.is_angle = torch.tensor(angles)
        size = recorded + sum(angles)
        following = spec.following + sum(angles[recorded - spec.following :])
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.zeros(size))  # 0: nobody has measured it yet
        self.sight = ValueSight(latent_channels, size, channels)
        self.motion = ValueMotion(size, following, width, stride, noise)
        self.painter = ValuePainter(size, stride=stride, channels=channels, width=width)

    @property
    def is_prepared(self) -> bool:
        """Whether the scale of its values is known."""
        return bool((self.std > 0).all())

    def prepare(self, mean: Tensor, std: Tensor) -> None:
        """Take the scale of the values; cosines and sines have none."""
        is_angle = self.is_angle.to(mean.device)
        zeros, ones = torch.zeros_like(mean), torch.ones_like(std)
        self.mean.copy_(_with_angles(torch.where(is_angle, zeros, mean), is_angle, zeros))
        self.std.copy_(_with_angles(torch.where(is_angle, ones, std), is_angle, ones))

    def encode(self, states: Tensor) -> Tensor:
        """The standardised values `[B, T, V]` of states."""
        is_angle = self.is_angle.to(states.device)
        values = _with_angles(torch.where(is_angle, states.cos(), states), is_angle, states.sin())
        # Where nothing was measured yet, the checks of components see values as they are.
        std = torch.where(self.std > 0, self.std, torch.ones_like(self.std))
        return (values - self.mean) / std

    def decode(self, course: Tensor) -> Tensor:
        """The states of values; see `Group.decode`."""
        values, is_angle = course * self.std + self.mean, self.is_angle.to(course.device)
        states, sines = values[..., : len(is_angle)], values[..., len(is_angle) :]
        if not sines.shape[-1]:
            return states
        angles = torch.atan2(sines, states[..., is_angle])
        return states.index_copy(-1, is_angle.nonzero()[:, 0], angles)

    def read(self, given: Tensor) -> Values:
        """The values that the last given frame shows, at rest."""
        values = self.sight(given[:, -1])
        return self.begin(values, values)

    def begin(self, frame: Tensor, previous: Tensor) -> Values:
        """The state of a scene that is so, as if at rest: velocities are values, too."""
        with torch.autocast(frame.device.type, enabled=False):
            return Values(frame, self.motion.begin(frame))

    def frame(self, state: Values) -> Tensor:
        """The values of a state."""
        return state.values

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions by video frames; see `ValueMotion.embed`."""
        return self.motion.embed(modulation)

    def step(self, state: Values, action: Tensor) -> Values:
        """The values one video frame later."""
        values, hidden = self.motion(action, state.values, state.hidden, state.chance)
        return state._replace(values=values, hidden=hidden)

    def canvas(self, features: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """A map of the values in the given frame, which are remembered."""
        given = past[:, 0]
        return self.painter.then(self.painter.map(given, features.shape[-2:])), given

    def paint(self, memory: Tensor, course: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
        """A map of the values, and a vector of them and of those in the given frame."""
        painted = self.painter.now(self.painter.map(course[:, 0], size))
        return painted, self.painter.tell(torch.cat([memory, course.flatten(1)], 1))

    @torch.no_grad()
    def as_read(self, base: Tensor, course: Tensor) -> Tensor:
        """A true course; while training, all along as wrong as its first frame is read."""
        if not self.training:
            return course
        wrong = (self.sight(base) - course[:, 0])[:, None]
        with torch.autocast(base.device.type, enabled=False):
            course = self.motion.displaced(course, wrong)
        noise = SHOWN_NOISE * torch.randn_like(course[:, :2])
        return torch.cat([course[:, :1] + noise[:, :1], course[:, 1:] + noise[:, 1:]], 1)

    def reading_loss(self, latents: Tensor, true: Tensor) -> Tensor:
        """The error of the values that it reads."""
        return functional.smooth_l1_loss(self.sight(latents), true, beta=0.1)

    def motion_loss(
        self, states: Tensor, actions: Tensor, random: Generator, progress: float
    ) -> Tensor:
        """The error of the values that actions lead to from true ones, which are a little off."""
        true = self.encode(states)
        noise = to_device(torch.randn(true[:, 0].shape, generator=random), true)
        last = true.shape[1] - 1
        frames = next((size for until, size in HORIZONS if progress < until and size < last), last)
        first = int(torch.randint(last - frames + 1, (), generator=random))
        clips = max(1, MOVED_FRAMES // frames)
        true, noise, actions = true[:clips], noise[:clips], actions[:clips].flatten(1, 2)
        with torch.autocast(true.device.type, enabled=False):
            start = true[:, first] + START_NOISE * noise
            rows = actions[:, self.stride + first :][:, :frames]
            later = true[:, first + 1 : first + 1 + frames]
            if not self.noise:
                # By the distance and not its square: what a missed grasp or a collision sends
                # elsewhere would outweigh all others.
                return functional.smooth_l1_loss(self._followed(start, rows), later, beta=0.05)
            size = (len(start), self.noise)
            draws = tuple(
                self._followed(start, rows, to_device(torch.randn(size, generator=random), start))
                for _ in range(2)
            )
            return energy_score((draws[0], draws[1]), later, value_distance)

    def movers(self) -> Sequence[nn.Module]:
        """What moves values."""
        return (self.motion,)

    def _followed(self, start: Tensor, actions: Tensor, *chance: Tensor) -> Tensor:
        """The values after each of the actions `[B, H, …]`, `[B, H, V]`."""
        passed: list[Tensor] = []
        values, hidden = start, self.motion.begin(start)
        for action in actions.unbind(1):
            values, hidden = self.motion(action, values, hidden, chance)
            passed.append(values)
        return torch.stack(passed, 1)


def value_distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean distance of values `[B, T, V]`, a scalar: Euclidean, per value."""
    squared = (first - second).square().mean(-1)
    return (squared + 1e-6).sqrt().mean()


def _with_angles(values: Tensor, is_angle: Tensor, sines: Tensor) -> Tensor:
    """Values with the sines of those that are angles after them."""
    return torch.cat([values, sines[..., is_angle]], -1)
