"""Bodies on a plane that agents push: their poses are read, moved and painted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from acwm_core.env.rotations import angle_code, angle_of_code
from acwm_core.model.batch import to_device
from acwm_core.model.dynamics import Keypoints
from acwm_scene.agent_sight import cell_places
from acwm_scene.body_motion import HIDDEN, AgentMotion, BodyMotion, Moving
from acwm_scene.body_painter import BodyPainter
from acwm_scene.body_sight import BodySight, pose_distance, pose_loss, sight_loss
from acwm_scene.body_windows import moving_windows
from acwm_scene.declared import GroupSpec, unit_of
from acwm_scene.group import SteppedGroup, at_frame, declared_keypoints, energy_score, stacked
from acwm_scene.nodes import View
from acwm_scene.poses import Poses, turned_back

FOLLOWED = 32
"""Clips of a step of `motion_loss` in which agents are followed; they learn fast."""

START_NOISE = 0.01
"""Noise on the true poses that motion is learned from, in units and rad."""


class BodyGroup(SteppedGroup):
    """Agents that the actions move, and bodies that they push about on a plane.

    It is for a camera that looks down on the plane, and bodies that keep their colours: number k is
    the same one in all episodes.

    Args:
        spec: how many there are, and what the camera sees.
        latent_channels: channels C of the codec.
        stride: video frames per latent frame.
        channels: size of all hidden layers.
        width: size of the conditioner's modulation.
        noise: numbers of each body that a draw depends on; 0 for one future.
        unit: metres that count as one, about the size of a body.
    """

    zoom: Tensor

    def __init__(
        self,
        spec: GroupSpec,
        *,
        latent_channels: int,
        stride: int,
        channels: int,
        width: int,
        noise: int = 0,
        unit: float | None = None,
        **_: object,
    ) -> None:
        super().__init__()
        assert spec.camera is not None
        self.spec, self.stride, self.noise = spec, stride, spec.bodies * noise
        self.unit = unit or unit_of(spec.camera, "bodies")
        self.view = View(spec.camera, self.unit)
        # By how much the weights take the plane to be larger than the camera sees it.
        self.register_buffer("zoom", torch.ones(()))
        agents, bodies = spec.agents, spec.bodies
        self.sight = BodySight(latent_channels, agents, bodies, channels)
        self.agent_motion = AgentMotion(agents, width, stride)
        self.body_motion = BodyMotion(channels, spec.folds, noise)
        self.painter = BodyPainter(agents, bodies, stride=stride, channels=channels, width=width)

    def encode(self, states: Tensor) -> Poses:
        """The poses in states: places in units, turns as cosine and sine; see `Group.encode`."""
        spec, (batch, frames, _) = self.spec, states.shape
        presence = spec.bodies if spec.has_presence else 0
        sizes = [2 * spec.agents, presence, spec.axes * spec.bodies, spec.bodies]
        agents, present, places, angles = states.split(sizes, 2)
        if not presence:
            present = torch.ones_like(angles)
        return Poses(
            agents.reshape(batch, frames, spec.agents, 2) / self.unit,
            present[:, :1, :, None].expand(-1, frames, -1, -1),
            places.reshape(batch, frames, spec.bodies, spec.axes)[..., :2] / self.unit,
            angle_code(angles, spec.folds),
        )

    def decode(self, course: Poses) -> Tensor:
        """The states of poses; heights are NaN, as nothing tells them.

        Of angles that look the same, the one that is nearest to 0.
        """
        places = self.unit * course.places
        if self.spec.axes == 3:
            places = functional.pad(places, (0, 1), value=math.nan)
        angles = angle_of_code(course.turns, self.spec.folds)
        agents = (self.unit * course.agents).flatten(2)
        present = [course.present[..., 0]] if self.spec.has_presence else []
        return torch.cat([agents, *present, places.flatten(2), angles], 2)

    def read(self, given: Tensor) -> Moving:
        """The poses in the last given frame, and how they changed since the one before."""
        cells = self._cells(given.shape[-2:])
        now, _ = self.sight(given[:, -1], cells)
        before = self.sight(given[:, -2], cells)[0] if given.shape[1] > 1 else now
        return self._begun(now, *(change / self.stride for change in self._changes(before, now)))

    def begin(self, frame: Poses, previous: Poses) -> Moving:
        """Things that move on as they did; see `Group.begin`."""
        return self._begun(frame, *self._changes(previous, frame))

    def frame(self, state: Moving) -> Poses:
        """The poses of a state."""
        return state.poses

    def past(self, state: Moving, frames: int) -> Poses:
        """The poses before, if things moved as they do now; see `Group.past`."""
        return stacked([self._earlier(state, number) for number in range(frames)])

    def with_draw(self, state: Moving, draw: Tensor) -> Moving:
        """The state with the numbers of each body that its future depends on."""
        return state._replace(chance=(draw.unflatten(1, (self.spec.bodies, -1)),))

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """Agents and bodies, by their numbers."""
        agents = (f"agent {number + 1}" for number in range(self.spec.agents))
        return (*agents, *(f"body {number + 1}" for number in range(self.spec.bodies)))

    def keypoints(self, course: Poses, aspect: float) -> Keypoints:
        """Their places on the plane as the camera sees them; NaN of bodies that are not there."""
        bodies = course.places
        if self.spec.has_presence:
            bodies = bodies.where(course.present > 0.5, math.nan)
        places = torch.cat([course.agents, bodies], -2)
        return declared_keypoints(self.view(places, aspect)[..., :2])

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions by agents and video frames; see `AgentMotion.embed`."""
        return self.agent_motion.embed(modulation)

    def step(self, state: Moving, action: Tensor) -> Moving:
        """The agents follow the action, and push."""
        agents = state.poses.agents
        change, hidden = self.agent_motion(action, agents, state.agent_change, state.hidden)
        return self.body_motion(state._replace(hidden=hidden), agents + change)

    def move(self, state: Moving, actions: Tensor) -> tuple[Moving, Poses]:
        """The state one latent frame later; see `Group.move`.

        Bodies that are in none of the scenes cost time and change nothing, so they are left out.
        """
        if torch.is_grad_enabled() or actions.is_cuda:  # which would wait for a number
            return super().move(state, actions)
        there = state.poses.present.amax(0)[:, 0].nonzero()[:, 0]
        moved, course = super().move(_of_bodies(state, lambda body: body[:, there]), actions)
        still = _of_bodies(state, torch.zeros_like)
        rest = stacked([state.poses] * self.stride)._replace(agents=course.agents)
        course = rest._replace(
            places=rest.places.index_copy(2, there, course.places),
            turns=rest.turns.index_copy(2, there, course.turns),
        )
        moved = moved._replace(
            poses=at_frame(course, -1),
            place_change=still.place_change.index_copy(1, there, moved.place_change),
            spin=still.spin.index_copy(1, there, moved.spin),
            chance=state.chance,
        )
        return moved, course

    def canvas(self, features: Tensor, past: Poses) -> tuple[Tensor, tuple[Tensor, ...]]:
        """What was where in the given frame; nothing else is remembered."""
        size = features.shape[-2:]
        return self.painter.then(self.painter.map(past, self._cells(size), size)), ()

    def paint(
        self, memory: tuple[Tensor, ...], course: Poses, size: torch.Size
    ) -> tuple[Tensor, Tensor]:
        """What is where; see `Group.paint`."""
        painted = self.painter.now(self.painter.map(course, self._cells(size), size))
        return painted, self.painter.vector.expand(len(painted), -1)

    def reading_loss(self, latents: Tensor, true: Poses) -> Tensor:
        """The error of poses, and of which bodies there are; see `sight_loss`."""
        seen, logits = self.sight(latents, self._cells(latents.shape[-2:]))
        return sight_loss(seen, logits, true)

    def motion_loss(
        self, states: Tensor, actions: Tensor, random: Generator, progress: float
    ) -> Tensor:
        """The error of agents that follow the actions, and of bodies in windows that get longer.

        Bodies are moved by what the agents truly did. Their places count by the distance and not
        its square: the few that a missed push sends elsewhere would outweigh all others.
        """
        with torch.autocast(states.device.type, enabled=False):
            true = self.encode(states)
            followed = self._agent_loss(true.agents, actions, random)
            window, changes = moving_windows(true, random, progress, self.spec.folds)
            return followed + self._body_loss(window, changes, random)

    def movers(self) -> Sequence[nn.Module]:
        """What moves agents, and bodies."""
        return self.agent_motion, self.body_motion

    def _agent_loss(self, agents: Tensor, actions: Tensor, random: Generator) -> Tensor:
        chosen = torch.randperm(len(agents), generator=random)[:FOLLOWED].to(agents.device)
        agents, actions = agents[chosen], actions[chosen].flatten(1, 2)
        noise = to_device(torch.randn(agents[:, 0].shape, generator=random), agents)
        passed: list[Tensor] = []
        place = agents[:, 0] + START_NOISE * noise
        change = torch.zeros_like(place)
        hidden = place.new_zeros(*place.shape[:2], HIDDEN)
        for action in actions[:, self.stride :].unbind(1):
            change, hidden = self.agent_motion(action, place, change, hidden)
            place = place + change
            passed.append(place)
        return functional.mse_loss(torch.stack(passed, 1), agents[:, 1:])

    def _body_loss(
        self, window: Poses, changes: tuple[Tensor, Tensor], random: Generator
    ) -> Tensor:
        """The error of the bodies in a window `[B, 1 + H, …]`, given how they moved before it.

        Of a model that draws, the energy score of two draws.
        """
        poses = at_frame(window, 0)
        noise = to_device(torch.randn(poses.places.shape, generator=random), poses.places)
        poses = poses._replace(places=poses.places + START_NOISE * noise * poses.present)
        begun = self._begun(poses, torch.zeros_like(poses.agents), *changes)
        path, true = window.agents[:, 1:], Poses(*(values[:, 1:] for values in window))
        if not self.noise:
            return pose_loss(self._pushed(begun, path), true)
        draws = tuple(
            self._pushed(begun._replace(chance=(self._chance(poses, random),)), path)
            for _ in range(2)
        )
        return energy_score((draws[0], draws[1]), true, pose_distance)

    def _chance(self, poses: Poses, random: Generator) -> Tensor:
        size = (*poses.places.shape[:2], self.noise // self.spec.bodies)
        return to_device(torch.randn(size, generator=random), poses.places)

    def _pushed(self, state: Moving, path: Tensor) -> Poses:
        """The poses in all frames of the path `[B, H, A, 2]` of the agents."""
        passed: list[Poses] = []
        for agents in path.unbind(1):
            state = self.body_motion(state, agents)
            passed.append(state.poses)
        return stacked(passed)

    def _begun(self, poses: Poses, agents: Tensor, places: Tensor, spin: Tensor) -> Moving:
        hidden = poses.agents.new_zeros(*poses.agents.shape[:2], HIDDEN)
        return Moving(poses, agents, hidden, places, spin)

    def _changes(self, before: Poses, now: Poses) -> tuple[Tensor, Tensor, Tensor]:
        """Changes of the agents' and of the bodies' places, and of the bodies' angles."""
        spin = angle_of_code(turned_back(now.turns, before.turns), self.spec.folds)[..., None]
        return now.agents - before.agents, now.places - before.places, spin

    def _earlier(self, state: Moving, frames: int) -> Poses:
        """The poses so many video frames before, if things moved as they do now."""
        poses = state.poses
        back = angle_code(frames * state.spin[..., 0], self.spec.folds)
        return Poses(
            poses.agents - frames * state.agent_change,
            poses.present,
            poses.places - frames * state.place_change,
            turned_back(poses.turns, back),
        )

    def _cells(self, size: torch.Size) -> Tensor:
        """Where on the plane the cells of a frame are, `[h w, 2]`, in units."""
        spots = cell_places(size, self.zoom.device)
        return self.zoom * self.view.on_ground(spots, size[1] / size[0])


def _of_bodies(state: Moving, function: Callable[[Tensor], Tensor]) -> Moving:
    """A state with a function applied to what it holds of each body, `[B, N, …]`."""
    present, places, turns = map(function, state.poses[1:])
    return state._replace(
        poses=Poses(state.poses.agents, present, places, turns),
        place_change=function(state.place_change),
        spin=function(state.spin),
        chance=tuple(map(function, state.chance)),
    )
