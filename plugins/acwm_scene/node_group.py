"""A rope or a cloth that agents push or hold: its nodes are read, moved and painted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from acwm_core.model.batch import to_device
from acwm_core.model.dynamics import Keypoints
from acwm_scene.declared import GroupSpec, unit_of
from acwm_scene.group import SteppedGroup, declared_keypoints, energy_score
from acwm_scene.node_motion import NodeMotion
from acwm_scene.node_painter import NodePainter
from acwm_scene.node_sight import NodeSight, form_loss
from acwm_scene.node_windows import node_windows
from acwm_scene.nodes import Form, NodeLayout, View, spacing, unstretched
from acwm_scene.value_layers import ValueMotion

FOUND = 0.2
"""Weight of the cross entropy of where agents are found."""

AGENT = 0.3
"""What a unit of the agents' places counts where they are moved."""

FOLLOWED = 64
"""Clips of a step of `motion_loss` in which agents are followed; they learn fast."""

START_NOISE = 0.03
"""Noise on the true places that motion is learned from, in units."""

SHOWN_NOISE = 0.05
"""Noise on the true places that drawing is learned from, beside the error of reading, in units."""

MOTION_CHANNELS = 64
"""Size of the layers that move nodes."""


class Nodes(NamedTuple):
    """The state of agents and nodes in a video frame.

    Attributes:
        form: where they are.
        hidden: what moves the agents, see `ValueMotion`.
        change: of the nodes since the frame before, `[B, N, D]`.
        spacing: how far apart neighbours are in the given frame, `[B]`.
        chance: numbers that this future depends on, `[B, noise]`, of a model that draws.
    """

    form: Form
    hidden: Tensor
    change: Tensor
    spacing: Tensor
    chance: tuple[Tensor, ...] = ()


class NodeGroup(SteppedGroup):
    """One rope or cloth, and the agents that the actions move. In the given frame nothing moves.

    Args:
        spec: how many there are, the camera, and the light if its shadows are to be seen.
        latent_channels: channels C of the codec.
        stride: video frames per latent frame.
        channels: size of the layers that look and paint.
        width: size of the conditioner's modulation.
        noise: numbers that a draw depends on; 0 for one future.
        stretch: share by which neighbours may get further apart than in the given frame; None if
            nothing keeps them together.
        unit: metres that count as one, a few times the distance of the nodes that are moved.
        every: every n-th node along each side is moved and painted.
    """

    def __init__(
        self,
        spec: GroupSpec,
        *,
        latent_channels: int,
        stride: int,
        channels: int,
        width: int,
        noise: int = 0,
        stretch: float | None = None,
        unit: float | None = None,
        every: int = 2,
    ) -> None:
        super().__init__()
        assert spec.camera is not None
        self.stride, self.stretch, self.noise = stride, stretch, noise
        unit = unit or unit_of(spec.camera, "nodes")
        self.layout = layout = NodeLayout(spec.agents, spec.axes, spec.nodes, every, unit)
        view, light = View(spec.camera, unit), spec.light
        self.agent_size = spec.agents * spec.axes
        self.sight = NodeSight(latent_channels, layout, view, light, channels)
        self.agent_motion = ValueMotion(spec.agents * spec.axes, 0, width, stride)
        self.node_motion = NodeMotion(layout, MOTION_CHANNELS, noise)
        self.painter = NodePainter(
            layout, view, light, stride=stride, channels=channels, width=width
        )

    def encode(self, states: Tensor) -> Form:
        """Where agents and nodes are, in units; see `Group.encode`."""
        return self.layout.form(states)

    def decode(self, course: Form) -> Tensor:
        """The states of a course; nodes that are not moved are on straight lines."""
        return self.layout.states(course)

    def read(self, given: Tensor) -> Nodes:
        """The form that the last given frame shows, at rest."""
        form = self.sight(given[:, -1])
        return self.begin(form, form)

    def begin(self, frame: Form, previous: Form) -> Nodes:
        """The state of a form at rest."""
        with torch.autocast(frame.nodes.device.type, enabled=False):
            hidden = self.agent_motion.begin(AGENT * frame.agents.flatten(1))
        apart = spacing(frame.nodes, self.layout.shape)
        return Nodes(frame, hidden, torch.zeros_like(frame.nodes), apart)

    def frame(self, state: Nodes) -> Form:
        """The form of a state."""
        return state.form

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """Agents, and the nodes that are moved, by their numbers."""
        agents = (f"agent {number + 1}" for number in range(self.layout.agents))
        nodes = range(math.prod(self.layout.shape))
        return (*agents, *(f"node {number + 1}" for number in nodes))

    def keypoints(self, course: Form, aspect: float) -> Keypoints:
        """Their places as the camera sees them."""
        places = torch.cat([course.agents, course.nodes], -2)
        return declared_keypoints(self.sight.view(places, aspect)[..., :2])

    def embed(self, modulation: Tensor) -> Tensor:
        """Embedded actions by video frames; see `ValueMotion.embed`."""
        return self.agent_motion.embed(modulation)

    def step(self, state: Nodes, action: Tensor) -> Nodes:
        """The agents follow the action, and push or pull the nodes."""
        form = state.form
        agents, hidden = self._followed_by(form.agents, action, state.hidden)
        nodes, change = self.node_motion(form, agents, state.change, state.chance)
        if self.stretch is not None:
            nodes = unstretched(nodes, self.layout.shape, (1 + self.stretch) * state.spacing)
            change = nodes - form.nodes
        return state._replace(form=Form(agents, nodes), hidden=hidden, change=change)

    def move_agents(self, state: Nodes, actions: Tensor) -> tuple[Nodes, Tensor]:
        """Agents follow their actions, whatever the nodes do; see `Group.move_agents`."""
        agents, hidden, passed = state.form.agents, state.hidden, list[Tensor]()
        for action in actions.unbind(1):
            agents, hidden = self._followed_by(agents, action, hidden)
            passed.append(self.layout.unit * agents.flatten(1))
        moved = state._replace(form=state.form._replace(agents=agents), hidden=hidden)
        return moved, torch.stack(passed, 1)

    def canvas(self, features: Tensor, past: Form) -> tuple[Tensor, Tensor]:
        """What was where in the given frame, and how it shows each node, which is remembered."""
        looks = self.painter.looks(features, past.nodes[:, 0])
        return self.painter.then(self.painter.map(past, looks, features.shape[-2:])), looks

    def paint(self, memory: Tensor, course: Form, size: torch.Size) -> tuple[Tensor, Tensor]:
        """What is where; see `Group.paint`."""
        painted = self.painter.now(self.painter.map(course, memory, size))
        return painted, self.painter.vector.expand(len(painted), -1)

    @torch.no_grad()
    def as_read(self, base: Tensor, course: Form) -> Form:
        """A true course, its nodes in the order in which they are read; see `Group.as_read`."""
        read = self.sight(base)
        first = Form(*(values[:, 0] for values in course))
        course = course.reversed(self._is_reversed(read, first))
        if not self.training:
            return course
        wrong = [mine - true[:, 0] for mine, true in zip(read, course, strict=True)]
        wrong = [offset + SHOWN_NOISE * torch.randn_like(offset[:, :1]) for offset in wrong]
        return Form(course.agents + wrong[0][:, None], course.nodes + wrong[1][:, None])

    def reading_loss(self, latents: Tensor, true: Form) -> Tensor:
        """The error of the forms from the first guess to the last one, and of the agents' cells."""
        forms, logits = self.sight.look(latents)
        true = true.reversed(self._is_reversed(forms[-1], true))
        loss = torch.stack([form_loss(form, true).mean() for form in forms]).mean()
        return loss + FOUND * self.sight.agents.loss(logits, true.agents, latents.shape[2:])

    def motion_loss(
        self, states: Tensor, actions: Tensor, random: Generator, progress: float
    ) -> Tensor:
        """The error of agents that follow the actions, and of nodes in windows that get longer.

        Nodes are moved by what the agents truly did.
        """
        true = self.encode(states)
        with torch.autocast(states.device.type, enabled=False):
            followed = self._agent_loss(true.agents, actions, random)
        window = node_windows(true, random, progress, self.layout.reversible)
        return followed + self._node_loss(window, random)

    def movers(self) -> Sequence[nn.Module]:
        """What moves agents, and nodes."""
        return self.agent_motion, self.node_motion

    def _followed_by(self, agents: Tensor, action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """The agents' places a video frame later, and what moves them."""
        moved, hidden = self.agent_motion(action, AGENT * agents.flatten(1), hidden)
        return (moved / AGENT).view_as(agents), hidden

    def _is_reversed(self, read: Form, true: Form) -> Tensor:
        """Whether the nodes were read from the other end, `[B]`."""
        whole = torch.ones(len(true.nodes), dtype=torch.bool, device=true.nodes.device)
        if not self.layout.reversible:
            return ~whole
        return form_loss(read, true.reversed(whole)) < form_loss(read, true)

    def _agent_loss(self, agents: Tensor, actions: Tensor, random: Generator) -> Tensor:
        chosen = torch.randperm(len(agents), generator=random)[:FOLLOWED].to(agents.device)
        agents, actions = agents[chosen], actions[chosen].flatten(1, 2)
        noise = to_device(torch.randn(agents[:, 0].shape, generator=random), agents)
        passed: list[Tensor] = []
        places = agents[:, 0] + START_NOISE * noise
        hidden = self.agent_motion.begin(AGENT * places.flatten(1))
        for action in actions[:, self.stride :].unbind(1):
            places, hidden = self._followed_by(places, action, hidden)
            passed.append(places)
        return functional.smooth_l1_loss(torch.stack(passed, 1), agents[:, 1:], beta=0.05)

    def _node_loss(self, window: Form, random: Generator) -> Tensor:
        """The error of the nodes in a window `[B, 2 + H, …]`; of draws, their energy score."""
        nodes = window.nodes
        together, single = (
            to_device(torch.randn(shape, generator=random), nodes)
            for shape in (nodes[:, 1, :1].shape, nodes[:, 1].shape)
        )
        begun = nodes[:, 1] + START_NOISE * (together + 0.3 * single)
        if not self.noise:
            moved = self._pushed(window, begun, ())
            return functional.smooth_l1_loss(moved, nodes[:, 2:], beta=0.05)
        draws = tuple(self._pushed(window, begun, (self._chance(nodes, random),)) for _ in range(2))
        return energy_score((draws[0], draws[1]), nodes[:, 2:], node_distance)

    def _chance(self, nodes: Tensor, random: Generator) -> Tensor:
        return to_device(torch.randn(len(nodes), self.noise, generator=random), nodes)

    def _pushed(self, window: Form, begun: Tensor, chance: tuple[Tensor, ...]) -> Tensor:
        """The nodes in the frames of a window after the first two, `[B, H, N, D]`."""
        form, change = Form(window.agents[:, 1], begun), window.nodes[:, 1] - window.nodes[:, 0]
        passed: list[Tensor] = []
        for number in range(2, window.nodes.shape[1]):
            agents = window.agents[:, number]
            moved, change = self.node_motion(form, agents, change, chance)
            form = Form(agents, moved)
            passed.append(moved)
        return torch.stack(passed, 1)


def node_distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean distance of nodes `[B, T, N, D]`, a scalar: of a whole line or sheet, per node."""
    squared = (first - second).square().sum(-1).mean(-1)
    return (squared + 1e-6).sqrt().mean()
