"""A predictor for bodies on a plane: it moves their poses, and draws the picture from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.model.objectives.objective import Batch, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.drawing import Drawing
from acwm_recurrent.layers import MatrixConv
from acwm_recurrent.motion import HIDDEN, AgentMotion, BodyMotion, Moving
from acwm_recurrent.poses import (
    Layout,
    Poses,
    angle_between,
    direction,
    flattened,
    history,
    later,
    pose_at,
    stacked,
    turned_back,
)
from acwm_recurrent.sight import Sight, pose_loss, sight_loss
from acwm_recurrent.windows import moving_windows

READ_FRAMES = 4
"""Frames of each clip from which it learns to read poses, the first one among them."""

FOLLOWED = 32
"""Clips of a step of `motion_loss` in which agents are followed; they learn fast."""

START_NOISE = 0.01
"""Noise on the true poses that motion is learned from, in units and rad."""


class Scene(NamedTuple):
    """What is passed from one latent frame to the next.

    Attributes:
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
        canvas: what all frames are drawn on, see `Drawing.canvas`.
        moving: poses in the last video frame, and how they change.
    """

    base: Tensor
    canvas: Tensor
    moving: Moving


class PlanarBodies(Predictor):
    """Reads the poses of agents and bodies from the given frame, moves them, and draws them.

    The picture is no part of what is carried from frame to frame: a body that moves wrongly is in
    the wrong place, and as solid as before. It is for a camera that looks down on a plane, bodies
    that keep their colours, number k the same one in all episodes, and data that hold their poses:

        data.states=[pusher_position,cube_present,cube_position,cube_yaw]

    in this order: places of the agents, presence, places and angles of the bodies (see `Layout`).
    `training.agent_steps` teaches how they move, without pictures. While it learns to draw, it
    draws what is truly there (teacher forcing).

    Args:
        latent_channels: channels C of the codec.
        state_size: number of values of the states.
        temporal_stride: video frames per latent frame of the codec.
        agents: number of agents, which the actions move.
        bodies: number of bodies, which agents push.
        folds: in how many ways a body can be turned and look the same; 4 for a cube.
        unit: metres that count as one, about the size of a body.
        view: metres from the middle of the picture to its upper edge.
        channels: size of all hidden layers.
        width: size of the conditioner's modulation.
        blocks: number of residual blocks that draw.

    Raises:
        RecipeError: a size below 1, or states that are not these.
    """

    layers, heads = 0, 1
    causal = streams = skips = follows_states = True

    def __init__(
        self,
        *,
        latent_channels: int,
        state_size: int = 0,
        temporal_stride: int = 4,
        agents: int = 1,
        bodies: int = 5,
        folds: int = 4,
        unit: float = 0.08,
        view: float = 0.335,
        channels: int = 96,
        width: int = 192,
        blocks: int = 4,
    ) -> None:
        super().__init__()
        if min(agents, bodies, folds, channels, width, blocks) < 1 or min(unit, view) <= 0:
            raise RecipeError("all parameters of planar_bodies must be positive")
        self.layout = Layout(agents, bodies, folds, unit, state_size)
        self.latent_channels, self.stride, self.width = latent_channels, temporal_stride, width
        self.view = view / unit
        self.sight = Sight(latent_channels, agents, bodies, channels)
        self.agent_motion = AgentMotion(agents, width, temporal_stride)
        self.body_motion = BodyMotion(channels, folds)
        self.drawing = Drawing(
            latent_channels,
            agents,
            bodies,
            stride=temporal_stride,
            channels=channels,
            width=width,
            blocks=blocks,
        )

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        *,
        only: Tensor | None = None,
        states: Tensor | None = None,
    ) -> Latent:
        """Predict the latent frames after the given ones, `[B, L − K, C, h, w]`.

        With `only`, those of them; with `states`, it draws true poses instead of its own.
        """
        known, base = given.shape[1], given[:, -1]
        cells = self._cells(base)
        if states is None:
            scene = self.start(given)
            canvas, course = scene.canvas, self._followed(scene, conditioning, known, frames)
        else:
            true = self.layout.poses(states)
            now = (known - 1) * self.stride
            last = torch.full((len(base), 1), now, device=base.device)
            canvas = self.drawing.canvas(base, flattened(history(true, last, self.stride)), cells)
            course = later(true, now)
        numbers = torch.arange(1, frames - known + 1, device=base.device).expand(len(base), -1)
        if only is not None:
            numbers = numbers.gather(1, only)
        shown = flattened(history(course, numbers * self.stride, self.stride))
        canvas = canvas[:, None].expand(-1, numbers.shape[1], -1, -1, -1).flatten(0, 1)
        changes = self.drawing(canvas, shown, cells)
        return base[:, None] + changes.unflatten(0, numbers.shape)

    def start(self, given: Latent) -> Scene:
        """What is known after the last of the given frames `[B, K, C, h, w]`.

        Raises:
            ShapeError: the latents have another number of channels.
        """
        if given.ndim != 5 or given.shape[2] != self.latent_channels:
            raise ShapeError(
                f"PlanarBodies takes latents [B, L, {self.latent_channels}, h, w], "
                f"not {list(given.shape)}"
            )
        base = given[:, -1]
        cells = self._cells(base)
        now, _ = self.sight(base, cells)
        before = self.sight(given[:, -2], cells)[0] if given.shape[1] > 1 else now
        moving = self._begun(now, *(each / self.stride for each in self._changes(before, now)))
        past = [self._earlier(moving, number) for number in range(self.stride)]
        return Scene(base, self.drawing.canvas(base, stacked(past), cells), moving)

    def step(self, scene: Scene, told: Tensor) -> tuple[Scene, Poses]:
        """One latent frame later, and the poses in its video frames `[B, stride, …]`, last first.

        Args:
            scene: after the previous latent frame.
            told: actions of its video frames, `[B, stride, A, ACTION]`, see `AgentMotion.told`.
        """
        moving, passed = scene.moving, list[Poses]()
        for action in told.unbind(1):
            moving = self._moved(moving, action)
            passed.insert(0, moving.poses)
        return scene._replace(moving=moving), stacked(passed)

    def state_loss(self, batch: Batch) -> Tensor:
        """The error of the poses that it reads from frames, and of how it moves them; see `Batch`.

        How they move is left out if `training.agent_steps` taught it.
        """
        assert batch.states is not None
        true, frames = self.layout.poses(batch.states), batch.latents.shape[1]
        read = batch.picked(min(READ_FRAMES, frames) - 1, frames - 1) + 1
        read = torch.cat([torch.zeros_like(read[:, :1]), read], 1)
        looked = batch.latents.take_along_dim(read[..., None, None, None], 1).flatten(0, 1)
        seen, logits = self.sight(looked, self._cells(looked))
        shown = flattened(history(true, read * self.stride, 1))
        loss = sight_loss(seen, logits, pose_at(shown, 0))
        if not self.body_motion.out.weight.requires_grad:
            return loss
        random = batch.generators[0]
        return loss + self.motion_loss(batch.states, batch.conditioning, random, progress=1)

    def motion_loss(
        self,
        states: Tensor,
        conditioning: Conditioning,
        random: torch.Generator,
        *,
        progress: float,
    ) -> Tensor:
        """The error of agents that follow the actions, and of bodies in windows that get longer.

        Bodies are moved by what the agents truly did. Their places count by the distance and not
        its square: the few that a missed push sends elsewhere would outweigh all others.
        """
        with torch.autocast(states.device.type, enabled=False):
            true = self.layout.poses(states)
            followed = self._agent_loss(true, conditioning, random)
            window, changes = moving_windows(true, random, progress, self.layout.folds)
            return followed + self._body_loss(window, changes, random)

    def stream(self, given: Latent, *, context: int) -> LatentStream:
        """Stream from the poses. `context` is ignored, as the scene holds all that is known."""
        return _PlanarStream(self, given)

    def matrices(self) -> list[nn.Parameter]:
        """The weights of the convolutions in the blocks and in the head that draw."""
        return [each.weight for each in self.drawing.modules() if isinstance(each, MatrixConv)]

    def initial_state(self, given: Latent, conditioning: Conditioning) -> tuple[Tensor, ...]:
        """The first state of a stream that begins with latents `[B, K, C, h, w]`, as tensors."""
        return _tensors(self.start(given))

    def next_state(
        self, state: tuple[Tensor, ...], conditioning: Conditioning
    ) -> tuple[Latent, tuple[Tensor, ...]]:
        """The next latent frame `[B, 1, C, h, w]` and its state, given the last conditioning."""
        told = self._told(conditioning)[:, -self.stride :]
        scene, poses = self.step(_scene(state), told)
        frame = scene.base + self.drawing(scene.canvas, poses, self._cells(scene.base))
        return frame[:, None], _tensors(scene)

    def _followed(self, scene: Scene, conditioning: Conditioning, known: int, frames: int) -> Poses:
        """Its own poses in all video frames after the given ones, `[B, T, …]`, and before them."""
        told, passed = self._told(conditioning), [scene.moving.poses]
        for frame in range(known, frames):
            rows = slice(frame * self.stride, (frame + 1) * self.stride)
            scene, poses = self.step(scene, told[:, rows])
            passed += [pose_at(poses, number) for number in reversed(range(self.stride))]
        return stacked(passed)

    def _agent_loss(
        self, true: Poses, conditioning: Conditioning, random: torch.Generator
    ) -> Tensor:
        chosen = torch.randperm(len(true.agents), generator=random)[:FOLLOWED]
        agents = true.agents[chosen.to(true.agents.device)]
        told = self._told(conditioning)[chosen.to(agents.device)]
        noise = sent(torch.randn(agents[:, 0].shape, generator=random), agents)
        place, passed = agents[:, 0] + START_NOISE * noise, list[Tensor]()
        change = torch.zeros_like(place)
        hidden = place.new_zeros(*place.shape[:2], HIDDEN)
        for action in told[:, self.stride :].unbind(1):
            change, hidden = self.agent_motion(action, place, change, hidden)
            place = place + change
            passed.append(place)
        return functional.mse_loss(torch.stack(passed, 1), agents[:, 1:])

    def _body_loss(
        self, window: Poses, changes: tuple[Tensor, Tensor], random: torch.Generator
    ) -> Tensor:
        """The error of the bodies in a window `[B, 1 + H, …]`, given how they moved before it."""
        there = window.present
        poses = pose_at(window, 0)
        noise = sent(torch.randn(poses.places.shape, generator=random), poses.places)
        poses = poses._replace(places=poses.places + START_NOISE * noise * there)
        change, spin = changes
        loss = poses.places.new_zeros(())
        for number in range(1, window.places.shape[1]):
            agents = window.agents[:, number]
            places, turns, change, spin = self.body_motion(poses, agents, change, spin)
            poses = Poses(agents, there, places, turns)
            loss = loss + pose_loss(poses, pose_at(window, number))
        return loss / (window.places.shape[1] - 1)

    def _moved(self, moving: Moving, action: Tensor) -> Moving:
        """One video frame later."""
        with torch.autocast(action.device.type, enabled=False):
            poses = moving.poses
            change, hidden = self.agent_motion(
                action.float(), poses.agents, moving.agent_change, moving.hidden
            )
            agents = poses.agents + change
            places, turns, moved, spin = self.body_motion(
                poses, agents, moving.place_change, moving.spin
            )
            return Moving(Poses(agents, poses.present, places, turns), change, hidden, moved, spin)

    def _begun(self, poses: Poses, agents: Tensor, places: Tensor, spin: Tensor) -> Moving:
        hidden = poses.agents.new_zeros(*poses.agents.shape[:2], HIDDEN)
        return Moving(poses, agents, hidden, places, spin)

    def _changes(self, before: Poses, now: Poses) -> tuple[Tensor, Tensor, Tensor]:
        """Changes of the agents' and of the bodies' places, and of the bodies' angles."""
        spin = angle_between(before.turns, now.turns) / self.layout.folds
        return now.agents - before.agents, now.places - before.places, spin

    def _earlier(self, moving: Moving, frames: int) -> Poses:
        """The poses so many video frames before, if things moved as they do now."""
        poses = moving.poses
        back = direction(self.layout.folds * frames * moving.spin[..., 0])
        return Poses(
            poses.agents - frames * moving.agent_change,
            poses.present,
            poses.places - frames * moving.place_change,
            turned_back(poses.turns, back),
        )

    def _cells(self, frame: Tensor) -> Tensor:
        """Where on the plane the cells of a frame `[B, C, h, w]` are, `[h w, 2]`."""
        height, width = frame.shape[-2:]
        rows, columns = (
            torch.arange(1 - size, size, 2, device=frame.device) * (self.view / height)
            for size in (height, width)
        )
        y, x = torch.meshgrid(-rows, columns, indexing="ij")
        return torch.stack([x, y], -1).flatten(0, 1)

    def _told(self, conditioning: Conditioning) -> Tensor:
        if conditioning.modulation is None:
            raise RecipeError(
                "planar_bodies takes actions as a modulation, which this conditioner does not "
                "give: set conditioner=adaln"
            )
        return self.agent_motion.told(conditioning.modulation)


class _PlanarStream(LatentStream):
    """A stream that carries the scene."""

    def __init__(self, model: PlanarBodies, given: Latent) -> None:
        self._model, self._state = model, _tensors(model.start(given))

    def advance(self, conditioning: Conditioning) -> Latent:
        """The next latent frame; see `LatentStream.advance`."""
        latent, self._state = self._model.next_state(self._state, conditioning)
        return latent


def _tensors(scene: Scene) -> tuple[Tensor, ...]:
    poses, *changes = scene.moving
    return (scene.base, scene.canvas, *poses, *changes)


def _scene(state: tuple[Tensor, ...]) -> Scene:
    base, canvas, *rest = state
    return Scene(base, canvas, Moving(Poses(*rest[:4]), *rest[4:]))
