"""A predictor for a rope or a cloth: it moves their nodes, and draws the picture from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.objective import Batch, sent
from acwm_core.model.shapes import Latent
from acwm_recurrent.node_drawing import NodeDrawing
from acwm_recurrent.node_motion import NodeMotion
from acwm_recurrent.node_sight import NodeSight, form_loss
from acwm_recurrent.node_windows import node_windows
from acwm_recurrent.nodes import Form, NodeLayout, View, spacing, unstretched
from acwm_recurrent.scene import SceneModel
from acwm_recurrent.states import StateMotion

READ_FRAMES = 3
"""Frames of each clip from which it learns to read forms, the first one among them."""

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


class Scene(NamedTuple):
    """What is passed from one latent frame to the next.

    Attributes:
        base: the given latent frame that predictions are relative to, `[B, C, h, w]`.
        canvas: what all frames are drawn on, see `NodeDrawing.canvas`.
        looks: how the given frame shows each node, see `NodeDrawing.canvas`.
        form: in the last video frame.
        hidden: what moves the agents, see `StateMotion`.
        change: of the nodes in the last video frame, `[B, N, D]`.
        spacing: how far apart neighbours are in the given frame, `[B]`.
    """

    base: Tensor
    canvas: Tensor
    looks: Tensor
    form: Form
    hidden: Tensor
    change: Tensor
    spacing: Tensor


class FlexibleBody(SceneModel[Scene, Form]):
    """Reads the nodes of a rope or a cloth from the given frame, moves them, and draws them.

    What is bent wrongly is in the wrong place, and as solid as before. It is for a camera that
    stands still in a known place, one rope or cloth that agents push or hold, and data that hold
    the places of the agents and of the nodes, in this order:

        data.states=[pole_position,rope_position] model.nodes=[80]

    In the given frame nothing moves. `training.agent_steps` teaches how they move, without
    pictures.

    Args:
        latent_channels: channels C of the codec.
        state_size: number of values of the states.
        temporal_stride: video frames per latent frame of the codec.
        agents: number of agents, which the actions move.
        nodes: number of nodes along a rope, or along both sides of a cloth.
        every: of which every so many-th along each side are moved and drawn.
        unit: metres that count as one, a few times the distance of these nodes.
        eye: where the camera stands, metres.
        target: what it looks at, metres.
        fov: its vertical field of view, degrees.
        light: direction to the light that casts shadows on the ground z = 0, if they are to be
            drawn.
        stretch: share by which neighbouring nodes may get further apart than in the given frame;
            None if nothing keeps them together.
        channels: size of the layers that look and draw.
        motion_channels: size of the layers that move nodes.
        width: size of the conditioner's modulation.
        blocks: number of residual blocks that draw.

    Raises:
        RecipeError: a size below 1, a negative stretch, or states, a camera or a light that are
            not these.
    """

    name = "flexible_body"
    raw_states = predicts_states = True

    def __init__(
        self,
        *,
        latent_channels: int,
        state_size: int = 0,
        temporal_stride: int = 4,
        agents: int = 1,
        nodes: Sequence[int] = (80,),
        every: int = 2,
        unit: float = 0.1,
        eye: Sequence[float] = (0.0, -2.2, 4.0),
        target: Sequence[float] = (0.0, -0.08, 0.0),
        fov: float = 33.5,
        light: Sequence[float] | None = None,
        stretch: float | None = None,
        channels: int = 96,
        motion_channels: int = 64,
        width: int = 192,
        blocks: int = 4,
    ) -> None:
        super().__init__(latent_channels, temporal_stride, width)
        if min(channels, motion_channels, width, blocks) < 1:
            raise RecipeError("all sizes of flexible_body must be at least 1")
        if stretch is not None and not stretch >= 0:
            raise RecipeError(f"model.stretch is {stretch}; it must be 0 or more, or null")
        self.stretch = stretch
        self.layout = layout = NodeLayout(agents, nodes, every, unit, state_size)
        view = View(eye, target, fov, unit)
        self.sight = NodeSight(latent_channels, layout, view, light, channels)
        self.agent_motion = StateMotion(agents * layout.axes, 0, width, temporal_stride)
        self.node_motion = NodeMotion(layout, motion_channels)
        self.drawing = NodeDrawing(
            latent_channels,
            layout,
            view,
            light,
            stride=temporal_stride,
            channels=channels,
            width=width,
            blocks=blocks,
        )

    def start(self, given: Latent) -> Scene:
        """What is known after the last of the given frames; see `SceneModel.start`."""
        base = self.checked(given)[:, -1]
        return self._begun(base, self.sight(base))

    def step(self, scene: Scene, told: Tensor) -> tuple[Scene, Form]:
        """One latent frame later, and the forms in its video frames, `[B, stride, …]`."""
        form, hidden, change, passed = scene.form, scene.hidden, scene.change, list[Form]()
        with torch.autocast(told.device.type, enabled=False):
            for action in told.unbind(1):
                agents, hidden = self._followed_by(form.agents, action, hidden)
                nodes, change = self.node_motion(form, agents, change)
                if self.stretch is not None:
                    longest = (1 + self.stretch) * scene.spacing
                    nodes = unstretched(nodes, self.layout.shape, longest)
                    change = nodes - form.nodes
                form = Form(agents, nodes)
                passed.insert(0, form)
        scene = scene._replace(form=form, hidden=hidden, change=change)
        return scene, _stacked(passed)

    def state_loss(self, batch: Batch) -> Tensor:
        """The error of the forms that it reads from frames, and of how it moves them; see `Batch`.

        How they move is left out if `training.agent_steps` taught it.
        """
        assert batch.states is not None
        true, frames = self.layout.form(batch.states), batch.latents.shape[1]
        read = batch.picked(min(READ_FRAMES, frames) - 1, frames - 1) + 1
        read = torch.cat([torch.zeros_like(read[:, :1]), read], 1)
        looked = batch.latents.take_along_dim(read[..., None, None, None], 1).flatten(0, 1)
        rows = torch.arange(len(read), device=read.device)[:, None]
        shown = Form(*(each[rows, self.stride * read].flatten(0, 1) for each in true))
        forms, found = self.sight.look(looked)
        shown = shown.reversed(self._turned_round(forms[-1], shown))
        loss = torch.stack([form_loss(each, shown).mean() for each in forms]).mean()
        loss = loss + FOUND * self.sight.agents.loss(found, shown.agents, looked.shape[2:])
        if not self.node_motion.out.weight.requires_grad:
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
        """The error of agents that follow the actions, and of nodes in windows that get longer.

        Nodes are moved by what the agents truly did.
        """
        true = self.layout.form(states)
        with torch.autocast(states.device.type, enabled=False):
            followed = self._agent_loss(true.agents, conditioning, random)
        window = node_windows(true, random, progress, self.layout.reversible)
        return followed + self._node_loss(window, random)

    def told(self, embedded: Tensor) -> Tensor:
        """Embedded actions by video frames; see `StateMotion.told`."""
        return self.agent_motion.told(embedded)

    def drawn(self, scene: Scene, shown: Form) -> Tensor:
        """The latent frame of forms in its video frames `[B, stride, …]`, the last one first."""
        return scene.base + self.drawing(scene.canvas, scene.looks, shown)

    def true_course(self, given: Latent, states: Tensor) -> tuple[Scene, Form]:
        """The true forms from the last given frame on, as wrong as they are read from it."""
        base, now = given[:, -1], (given.shape[1] - 1) * self.stride
        true = self.layout.form(states[:, now:])
        with torch.no_grad():
            read = self.sight(base)
            true = true.reversed(self._turned_round(read, true.at(0)))
            if self.training:
                off = [mine - real[:, 0] for mine, real in zip(read, true, strict=True)]
                off = [each + SHOWN_NOISE * torch.randn_like(each[:, :1]) for each in off]
                true = Form(true.agents + off[0][:, None], true.nodes + off[1][:, None])
        return self._begun(base, true.at(0)), true

    def joined(self, scene: Scene, passed: list[Form]) -> Form:
        """The forms in all video frames from that of the scene on, `[B, 1 + T, …]`."""
        pairs = zip(scene.form, *passed, strict=True)
        return Form(
            *(
                torch.cat([first[:, None], *(each.flip(1) for each in later)], 1)
                for first, *later in pairs
            )
        )

    def drawn_course(self, scene: Scene, course: Form, numbers: Tensor) -> Latent:
        """The latent frames with these numbers; see `SceneModel.drawn_course`."""
        shown = numbers[..., None] * self.stride - torch.arange(self.stride, device=numbers.device)
        rows = torch.arange(len(numbers), device=numbers.device)[:, None, None]
        forms = Form(*(each[rows, shown].flatten(0, 1) for each in course))
        base, canvas, looks = (
            each.repeat_interleave(numbers.shape[1], 0)
            for each in (scene.base, scene.canvas, scene.looks)
        )
        frames = self.drawn(scene._replace(base=base, canvas=canvas, looks=looks), forms)
        return frames.unflatten(0, numbers.shape)

    def states_of(self, course: Form) -> Tensor:
        """The states of the forms; see `SceneModel.states_of`."""
        return self.layout.states(course)

    def tensors(self, scene: Scene) -> tuple[Tensor, ...]:
        """The scene as tensors."""
        return (*scene[:3], *scene.form, *scene[4:])

    def scene(self, state: tuple[Tensor, ...]) -> Scene:
        """The inverse of `tensors`."""
        base, canvas, looks, agents, nodes, *others = state
        return Scene(base, canvas, looks, Form(agents, nodes), *others)

    def _begun(self, base: Tensor, form: Form) -> Scene:
        with torch.autocast(base.device.type, enabled=False):
            hidden = self.agent_motion.begin(AGENT * form.agents.flatten(1))
        still = Form(*(each[:, None].expand(-1, self.stride, -1, -1) for each in form))
        canvas, looks = self.drawing.canvas(base, still)
        apart = spacing(form.nodes, self.layout.shape)
        return Scene(base, canvas, looks, form, hidden, torch.zeros_like(form.nodes), apart)

    def _followed_by(self, agents: Tensor, action: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """The agents' places a video frame later, and what moves them."""
        moved, hidden = self.agent_motion(action, AGENT * agents.flatten(1), hidden)
        return (moved / AGENT).view_as(agents), hidden

    def _turned_round(self, read: Form, true: Form) -> Tensor:
        """Whether it counted the nodes from the other end, `[B]`."""
        if not self.layout.reversible:
            return torch.zeros(len(true.nodes), dtype=torch.bool, device=true.nodes.device)
        everything = torch.ones(len(true.nodes), dtype=torch.bool, device=true.nodes.device)
        return form_loss(read, true.reversed(everything)) < form_loss(read, true)

    def _agent_loss(
        self, agents: Tensor, conditioning: Conditioning, random: torch.Generator
    ) -> Tensor:
        chosen = torch.randperm(len(agents), generator=random)[:FOLLOWED].to(agents.device)
        agents, told = agents[chosen], self.told_of(conditioning)[chosen]
        noise = sent(torch.randn(agents[:, 0].shape, generator=random), agents)
        places, passed = agents[:, 0] + START_NOISE * noise, list[Tensor]()
        hidden = self.agent_motion.begin(AGENT * places.flatten(1))
        for action in told[:, self.stride :].unbind(1):
            places, hidden = self._followed_by(places, action, hidden)
            passed.append(places)
        return functional.smooth_l1_loss(torch.stack(passed, 1), agents[:, 1:], beta=0.05)

    def _node_loss(self, window: Form, random: torch.Generator) -> Tensor:
        """The error of the nodes in a window `[B, 2 + H, …]`."""
        nodes = window.nodes
        whole, each = (
            sent(torch.randn(shape, generator=random), nodes)
            for shape in (nodes[:, 1, :1].shape, nodes[:, 1].shape)
        )
        form, change = window.at(1), nodes[:, 1] - nodes[:, 0]
        form = form._replace(nodes=form.nodes + START_NOISE * (whole + 0.3 * each))
        passed = list[Tensor]()
        for number in range(2, nodes.shape[1]):
            agents = window.agents[:, number]
            moved, change = self.node_motion(form, agents, change)
            form = Form(agents, moved)
            passed.append(moved)
        return functional.smooth_l1_loss(torch.stack(passed, 1), nodes[:, 2:], beta=0.05)


def _stacked(forms: Sequence[Form]) -> Form:
    """Forms of several frames as one, `[B, T, …]`."""
    return Form(*(torch.stack(list(each), 1) for each in zip(*forms, strict=True)))
