"""Points of a scene, which nobody declared: what they are is learnt from video and actions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from acwm_core.model.batch import to_device
from acwm_core.model.dynamics import Keypoints
from acwm_scene.group import Group, energy_score, stacked
from acwm_scene.point_motion import PointMotion, Points
from acwm_scene.point_painter import PointPainter
from acwm_scene.point_sight import PointSight

FEATURES = 4
"""Numbers that tell what a point looks like."""

SHOWN_NOISE = (0.02, 0.06)
"""Noise on places and on features that drawing is learned from: what it need not bear, a point may
use for anything."""

START_NOISE = 0.03
"""Noise on the points that motion is learned from, in standard deviations."""

DECLARED_NOISE = 0.03
"""Noise on what is declared that motion is learned beside: by then it is predicted, too."""

WINDOWS = ((0.35, 2), (0.7, 5))
"""Until which share of the training motion is learned from windows of so many latent frames; then
from whole clips, in which errors add up."""

MOVED_FRAMES, FEWEST_CLIPS = 288, 24
"""Most latent frames that a step of motion moves, of all its clips, and the fewest clips."""

ALIVE = 0.08
"""A point is alive if the drawing cares for it so much, as a share of what it cares for most."""


class PointGroup(Group):
    """Points that it finds by itself, as `learn_points` teaches, moved by actions and each other.

    The states of points are what it reads: places from −1 to 1, right and down, and features.

    Args:
        points: number of points K.
        latent_channels: channels C of the codec.
        stride: video frames per latent frame.
        channels: size of the grid that is drawn on.
        width: size of the conditioner's modulation.
        noise: numbers that a draw depends on; 0 for one future.
        declared: numbers V that tell, in each video frame, how what the card declares is, such as
            the joints of a robot; points move with regard to it.
    """

    weight: Tensor

    def __init__(
        self,
        points: int,
        *,
        latent_channels: int,
        stride: int,
        channels: int,
        width: int,
        noise: int = 0,
        declared: int = 0,
        **_: object,
    ) -> None:
        super().__init__()
        self.stride, self.noise, self.shape = stride, noise, (points, 2 + FEATURES)
        self.register_buffer("weight", torch.ones(self.shape))
        self.sight = PointSight(latent_channels, points, FEATURES)
        self.motion = PointMotion(points, FEATURES, width, noise, stride * declared)
        self.painter = PointPainter(points, FEATURES, channels=channels, width=width)

    @property
    def size(self) -> int:
        """Numbers of all points."""
        return self.shape[0] * self.shape[1]

    def measure(self, courses: Tensor, costs: Tensor) -> None:
        """Take the scale of the points, and what their errors count.

        Args:
            courses: as they were read, `[N, K, 2 + F]`.
            costs: what an error of one standard deviation of each number costs the drawing,
                `[K, 2 + F]`.
        """
        self.motion.mean.copy_(courses.mean(0))
        self.motion.std.copy_(courses.std(0).clamp(min=0.02))
        costs = costs / costs.max().clamp(min=1e-9)
        alive = costs[costs.norm(dim=1) > ALIVE]
        self.weight.copy_(costs / alive.square().mean().sqrt() / self.motion.std)

    def encode(self, states: Tensor) -> Tensor:
        """The course `[B, T, K, 2 + F]`."""
        return states.unflatten(-1, self.shape)

    def decode(self, course: Tensor) -> Tensor:
        """The inverse of `encode`."""
        return course.flatten(-2)

    def read(self, given: Tensor) -> Points:
        """The points that the last given frame shows, and how they changed before it."""
        points = self.sight(given[:, -1])
        return self.begin(points, self.sight(given[:, -2]) if given.shape[1] > 1 else points)

    def begin(self, frame: Tensor, previous: Tensor) -> Points:
        """The state of points that were as in `previous` in the latent frame before."""
        with torch.autocast(frame.device.type, enabled=False):
            return self.motion.begin(frame.float(), (frame - previous).float())

    def frame(self, state: Points) -> Tensor:
        """The points of a state."""
        return state.points

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """The points, by their numbers."""
        return tuple(f"point {number + 1}" for number in range(self.shape[0]))

    def keypoints(self, course: Tensor, aspect: float) -> Keypoints:
        """The points, whose places are in the picture already, with what drawing cares for."""
        costs = (self.weight * self.motion.std).norm(dim=1)
        return Keypoints(course, self.weight, costs / costs.max().clamp(min=1e-9))

    def moved_to(self, state: Points, number: int, place: Tensor) -> Points:
        """The state in which a point is at another place `[2]`, as if it had been pushed there."""
        change = torch.zeros_like(state.points)
        change[:, number, :2] = place - state.points[:, number, :2]
        return state._replace(points=state.points + change, pushed=state.pushed + change)

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions by latent frames; see `PointMotion.embed`."""
        return self.motion.embed(modulation)

    def with_declared(
        self, actions: Tensor, declared: Tensor, random: Generator | None = None
    ) -> Tensor:
        """Embedded actions that also tell what declared things do meanwhile.

        Args:
            actions: by latent frames, `[B, L, ACTION]`.
            declared: the course of declared things in the video frames of the last of these latent
                frames, `[B, stride · N, V]`; as in a clip, whose first frame nothing leads to.
            random: of noise on the course, in training.

        Returns:
            `[B, L, ACTION]`.
        """
        assert self.motion.declared is not None
        if random is not None:
            noise = to_device(torch.randn(declared.shape, generator=random), declared)
            declared = declared + DECLARED_NOISE * noise
        embedded = self.motion.declared(declared.unflatten(1, (-1, self.stride)).flatten(2))
        return actions + functional.pad(embedded, (0, 0, actions.shape[1] - embedded.shape[1], 0))

    def move(self, state: Points, actions: Tensor) -> tuple[Points, Tensor]:
        """The points one latent frame later, in which they do not move; see `Group.move`."""
        state = self.motion(actions, state)
        return state, stacked([state.points] * self.stride)

    def canvas(self, features: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """A map of the points in the given frame, which are remembered."""
        given = past[:, 0]
        return self.painter.then(self.painter.map(given, features.shape[-2:])), given

    def paint(self, memory: Tensor, course: Tensor, size: torch.Size) -> tuple[Tensor, Tensor]:
        """A map of the points, and a vector of them and of those in the given frame."""
        points = course[:, 0]
        painted = self.painter.now(self.painter.map(points, size))
        return painted, self.painter.tell(torch.cat([memory, points], 1).flatten(1))

    def as_read(self, base: Tensor, course: Tensor) -> Tensor:
        """A course as it was read; while training, with noise."""
        if not self.training:
            return course
        places, features = SHOWN_NOISE
        scale = torch.full_like(course[0, 0], features)
        scale[:, :2] = places
        return course + scale * torch.randn_like(course)

    def reading_loss(self, latents: Tensor, true: Tensor) -> Tensor:
        """Zero: nobody knows better."""
        return latents.new_zeros(())

    def motion_loss(
        self, states: Tensor, actions: Tensor, random: Generator, progress: float
    ) -> Tensor:
        """The error of the points after each latent frame, by what it costs the drawing.

        Their states between latent frames are not known.
        """
        course = self.encode(states)[:, :: self.stride]
        last = course.shape[1] - 1
        frames = next((size for until, size in WINDOWS if progress < until and size < last), last)
        clips = max(FEWEST_CLIPS, MOVED_FRAMES // frames)
        first = int(torch.randint(last - frames + 1, (), generator=random))
        if torch.rand((), generator=random) < 0.4:
            first = 0
        change = course[:clips, first] - course[:clips, max(0, first - 1)]
        course, actions = course[:clips, first:][:, : frames + 1], actions[:clips]
        noise = to_device(torch.randn(course[:, 0].shape, generator=random), course)
        with torch.autocast(states.device.type, enabled=False):
            start = course[:, 0] + START_NOISE * self.motion.std * noise
            rows = actions[:, first + 1 :][:, :frames]
            later = self.weight * course[:, 1:]
            if not self.noise:
                moved = self.weight * self._moved(start, change, rows)
                return functional.smooth_l1_loss(moved, later, beta=0.05)
            size = (len(start), self.noise)
            draws = tuple(
                self.weight
                * self._moved(
                    start, change, rows, to_device(torch.randn(size, generator=random), start)
                )
                for _ in range(2)
            )
            return energy_score((draws[0], draws[1]), later, point_distance)

    def movers(self) -> Sequence[nn.Module]:
        """What moves points."""
        return (self.motion,)

    def _moved(self, start: Tensor, change: Tensor, actions: Tensor, *chance: Tensor) -> Tensor:
        """The points after each of the actions `[B, H, ACTION]`, `[B, H, K, 2 + F]`."""
        moved: list[Tensor] = []
        state = self.motion.begin(start, change)._replace(chance=chance)
        for action in actions.unbind(1):
            state = self.motion(action, state)
            moved.append(state.points)
        return torch.stack(moved, 1)


def point_distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean distance of points `[B, T, K, D]`, a scalar: of all points of a frame together."""
    squared = (first - second).square().flatten(2).mean(-1)
    return (squared + 1e-6).sqrt().mean()
