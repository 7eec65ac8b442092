"""A predictor for bodies on a plane: it moves their poses, and draws the picture from them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.objective import Batch, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.drawing import Drawing
from acwm_recurrent.motion import HIDDEN, AgentMotion, BodyMotion, Moving
from acwm_recurrent.poses import (
    Layout,
    Poses,
    angle_between,
    concatenated,
    direction,
    flattened,
    history,
    later,
    pose_at,
    stacked,
    turned_back,
)
from acwm_recurrent.scene import SceneModel
from acwm_recurrent.sight import Sight, pose_distance, pose_loss, sight_loss
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


class PlanarBodies(SceneModel[Scene, Poses]):
    """Reads the poses of agents and bodies from the given frame, moves them, and draws them.

    A body that moves wrongly is in the wrong place, and as solid as before. It is for a camera that
    looks down on a plane, bodies that keep their colours, number k the same one in all episodes,
    and data that hold their poses:

        data.states=[pusher_position,cube_present,cube_position,cube_yaw]

    in this order: places of the agents, presence, places and angles of the bodies (see `Layout`).
    `training.agent_steps` teaches how they move, without pictures.

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
        noise: numbers of each body that a draw depends on; 0 for a model that predicts one future.

    Attributes:
        noise: those of all bodies together.

    Raises:
        RecipeError: a size below 1, or states that are not these.
    """

    name = "planar_bodies"
    raw_states = predicts_states = True

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
        noise: int = 0,
    ) -> None:
        super().__init__(latent_channels, temporal_stride, width)
        if min(agents, bodies, folds, channels, width, blocks) < 1 or min(unit, view) <= 0:
            raise RecipeError("all parameters of planar_bodies but noise must be positive")
        if noise < 0:
            raise RecipeError(f"model.noise is {noise}; it must be at least 0")
        self.noise, self.samples = bodies * noise, noise > 0
        self.layout = Layout(agents, bodies, folds, unit, state_size)
        self.view = view / unit
        self.sight = Sight(latent_channels, agents, bodies, channels)
        self.agent_motion = AgentMotion(agents, width, temporal_stride)
        self.body_motion = BodyMotion(channels, folds, noise)
        self.drawing = Drawing(
            latent_channels,
            agents,
            bodies,
            stride=temporal_stride,
            channels=channels,
            width=width,
            blocks=blocks,
        )

    def start(self, given: Latent) -> Scene:
        """What is known after the last of the given frames; see `SceneModel.start`."""
        base = self.checked(given)[:, -1]
        cells = self._cells(base)
        now, _ = self.sight(base, cells)
        before = self.sight(given[:, -2], cells)[0] if given.shape[1] > 1 else now
        moving = self._begun(now, *(each / self.stride for each in self._changes(before, now)))
        past = [self._earlier(moving, number) for number in range(self.stride)]
        return Scene(base, self.drawing.canvas(base, stacked(past), cells), moving)

    def with_draw(self, scene: Scene, draw: Tensor) -> Scene:
        """The scene with the numbers of a draw; see `SceneModel.with_draw`."""
        chance = draw.unflatten(1, (self.layout.bodies, -1))
        return scene._replace(moving=scene.moving._replace(chance=(chance,)))

    def step(self, scene: Scene, told: Tensor) -> tuple[Scene, Poses]:
        """One latent frame later, and the poses in its video frames, `[B, stride, …]`."""
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

    def told(self, embedded: Tensor) -> Tensor:
        """Embedded actions by agents and video frames; see `AgentMotion.told`."""
        return self.agent_motion.told(embedded)

    def drawn(self, scene: Scene, shown: Poses) -> Tensor:
        """The latent frame of poses in its video frames `[B, stride, …]`, the last one first."""
        return scene.base + self.drawing(scene.canvas, shown, self._cells(scene.base))

    def true_course(self, given: Latent, states: Tensor) -> tuple[Scene, Poses]:
        """The true poses from the last given frame on."""
        true, now = self.layout.poses(states), (given.shape[1] - 1) * self.stride
        last = torch.full((len(given), 1), now, device=given.device)
        base, past = given[:, -1], flattened(history(true, last, self.stride))
        canvas = self.drawing.canvas(base, past, self._cells(base))
        begun = pose_at(true, now)
        moving = self._begun(begun, *self._changes(begun, begun))
        return Scene(base, canvas, moving), later(true, now)

    def joined(self, scene: Scene, passed: list[Poses]) -> Poses:
        """The poses in all video frames from that of the scene on, `[B, 1 + T, …]`."""
        frames = [pose_at(each, k) for each in passed for k in reversed(range(self.stride))]
        return stacked([scene.moving.poses, *frames])

    def drawn_course(self, scene: Scene, course: Poses, numbers: Tensor) -> Latent:
        """The latent frames with these numbers; see `SceneModel.drawn_course`."""
        shown = flattened(history(course, numbers * self.stride, self.stride))
        base, canvas = (
            each.repeat_interleave(numbers.shape[1], 0) for each in (scene.base, scene.canvas)
        )
        frames = self.drawn(scene._replace(base=base, canvas=canvas), shown)
        return frames.unflatten(0, numbers.shape)

    def states_of(self, course: Poses) -> Tensor:
        """The states of the poses; see `SceneModel.states_of`."""
        return self.layout.states(course)

    def tensors(self, scene: Scene) -> tuple[Tensor, ...]:
        """The scene as tensors."""
        poses, *changes, chance = scene.moving
        return (scene.base, scene.canvas, *poses, *changes, *chance)

    def scene(self, state: tuple[Tensor, ...]) -> Scene:
        """The inverse of `tensors`."""
        base, canvas, *rest = state
        moving = Moving(Poses(*rest[:4]), *rest[4:8], chance=tuple(rest[8:]))
        return Scene(base, canvas, moving)

    def _agent_loss(
        self, true: Poses, conditioning: Conditioning, random: torch.Generator
    ) -> Tensor:
        chosen = torch.randperm(len(true.agents), generator=random)[:FOLLOWED]
        agents = true.agents[chosen.to(true.agents.device)]
        told = self.told_of(conditioning)[chosen.to(agents.device)]
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
        """The error of the bodies in a window `[B, 1 + H, …]`, given how they moved before it.

        Of a model that draws, the energy score of two draws; see `EnergyScore`.
        """
        poses = pose_at(window, 0)
        noise = sent(torch.randn(poses.places.shape, generator=random), poses.places)
        poses = poses._replace(places=poses.places + START_NOISE * noise * poses.present)
        begun = self._begun(poses, torch.zeros_like(poses.agents), *changes)
        path = window.agents[:, 1:]
        true = concatenated(pose_at(window, frame) for frame in range(1, window.places.shape[1]))
        if not self.samples:
            return pose_loss(self._pushed(begun, path), true)
        first, second = (
            self._pushed(begun._replace(chance=(self._chance(poses, random),)), path)
            for _ in range(2)
        )
        far = pose_distance(first, true) + pose_distance(second, true)
        return (far - pose_distance(first, second)) / 2

    def _chance(self, poses: Poses, random: torch.Generator) -> Tensor:
        size = (*poses.places.shape[:2], self.noise // self.layout.bodies)
        return sent(torch.randn(size, generator=random), poses.places)

    def _pushed(self, moving: Moving, path: Tensor) -> Poses:
        """The poses `[H B, …]` in all frames of the path `[B, H, A, 2]` of the agents."""
        passed = list[Poses]()
        for agents in path.unbind(1):
            moving = self.body_motion(moving, agents)
            passed.append(moving.poses)
        return concatenated(passed)

    def _moved(self, moving: Moving, action: Tensor) -> Moving:
        """One video frame later."""
        with torch.autocast(action.device.type, enabled=False):
            poses = moving.poses
            change, hidden = self.agent_motion(
                action.float(), poses.agents, moving.agent_change, moving.hidden
            )
            return self.body_motion(moving._replace(hidden=hidden), poses.agents + change)

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
