"""Reads where agents and nodes are from a latent frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.agent_sight import AgentPlaces, AgentSight
from acwm_scene.ground_look import GroundLook
from acwm_scene.layers import Overview
from acwm_scene.nodes import (
    Form,
    NodeBlock,
    NodeLayout,
    View,
    ahead_of,
    along_sides,
    evenly,
    seen_at,
    seen_from,
)
from acwm_scene.poses import waves, waves_size

POINTS, HIDDEN, OCTAVES = 32, 256, 3

ROUNDS = 3
"""How often it looks again where it thinks that things are."""

HELD = 5.6
"""What is held is read as if the first two agents were so many units apart."""

LEAST = 0.5
"""How many units apart they are at least, so that nothing is divided by 0."""

SPREAD = 4.0
"""Scale of the first guess, in units."""


class NodeSight(Overview):
    """Guesses from the whole frame where things are, then looks there and corrects itself.

    So a snake finds a contour (Kass et al. 1988): what the picture shows at each node, on the
    ground below it and where its shadow would fall, and where its neighbours are, tell where it
    should move. The nodes of a rope are kept at equal distances.

    Args:
        latent_channels: channels C of the latent.
        layout: of the nodes.
        view: the camera.
        light: direction to the light that casts shadows on the ground, if there is one.
        channels: channels of its convolutions.
    """

    def __init__(
        self,
        latent_channels: int,
        layout: NodeLayout,
        view: View,
        light: Sequence[float] | None,
        channels: int,
    ) -> None:
        super().__init__(latent_channels, channels, POINTS)
        self.layout, self.view = layout, view
        axes, sides = layout.axes, len(layout.shape)
        self.guess = nn.Sequential(
            nn.Linear(self.size, HIDDEN),
            nn.SiLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.SiLU(),
        )
        self.guess_nodes = nn.Linear(HIDDEN, math.prod(layout.shape) * axes)
        self.agents = AgentSight(latent_channels, layout, view, light)
        self.ground = GroundLook(view, light) if axes == 3 else None
        seen = channels * (1 + (self.ground.looks if self.ground else 0))
        place = waves_size(axes, OCTAVES)
        self.agent = nn.Sequential(
            nn.Linear(seen + place, channels), nn.SiLU(), nn.Linear(channels, axes)
        )
        self.tell = nn.Linear(seen + place + 2 * sides * axes, channels)
        self.blocks = nn.ModuleList(NodeBlock(sides, channels, reach) for reach in (1, 2, 4))
        self.shift = nn.Linear(channels, axes)

    def forward(self, frame: Tensor) -> Form:
        """The form that a latent frame `[B, C, h, w]` shows."""
        return self.look(frame)[0][-1]

    def look(self, frame: Tensor) -> tuple[list[Form], AgentPlaces]:
        """The forms from the first guess to the last one, and how the agents were found."""
        grid = self.features(frame)
        hidden = self.guess(self.summary(grid))
        located = self.agents(frame)
        forms = [Form(located.places, self._guessed(hidden, located.places))]
        for _ in range(ROUNDS):
            forms.append(self._corrected(grid.float(), forms[-1]))
        return forms, located

    def _guessed(self, hidden: Tensor, agents: Tensor) -> Tensor:
        """A first guess of the nodes, as they are seen from the agents where there are several."""
        nodes = self.guess_nodes(hidden).float().unflatten(1, (-1, self.layout.axes))
        if agents.shape[1] == 1:
            return self._evenly(SPREAD * nodes)
        agents = agents.detach()  # they are not learned by what hangs from them
        back = ahead_of(agents) * agents.new_tensor([1.0, -1.0])
        nodes = HELD * self._size(agents) * nodes
        return agents.mean(1, keepdim=True) + seen_from(back, nodes)

    def _corrected(self, grid: Tensor, form: Form) -> Form:
        # Where it looks is not learned by looking.
        agents, nodes = (places.detach() for places in form)
        seen, at_nodes = self._seen(grid, agents), self._seen(grid, nodes)
        held, there = (self._held(agents, places) for places in (agents, nodes))
        shift = self.agent(torch.cat([seen, waves(held / 2, OCTAVES)], -1))
        size, sides = self._size(agents), along_sides(nodes, self.layout.shape)
        inputs = [at_nodes, waves(there / size / 2, OCTAVES), sides / size]
        features = self.tell(torch.cat(inputs, -1))
        for block in self.blocks:
            features = block(features, self.layout.shape)
        moved = form.nodes + size * self.shift(functional.silu(features)).float()
        return Form(form.agents + shift.float(), self._evenly(moved))

    def _size(self, agents: Tensor) -> Tensor:
        """Scale of what is held, `[B, 1, 1]`: a larger cloth is a smaller one, seen from nearer."""
        if agents.shape[1] == 1:
            return agents.new_ones(len(agents), 1, 1)
        apart = (agents[:, 1:2] - agents[:, :1]).norm(dim=-1, keepdim=True)
        return apart.clamp(min=LEAST) / HELD

    def _held(self, agents: Tensor, places: Tensor) -> Tensor:
        """Places as its corrections hear of them: as seen from the agents, where there are several.

        So what hangs from them is read alike wherever it hangs.
        """
        if agents.shape[1] == 1:
            return places
        return seen_from(ahead_of(agents), places - agents.mean(1, keepdim=True))

    def _evenly(self, nodes: Tensor) -> Tensor:
        return evenly(nodes) if len(self.layout.shape) == 1 else nodes

    def _seen(self, grid: Tensor, places: Tensor) -> Tensor:
        """What the frame shows at places `[B, N, D]`: `[B, N, channels]`."""
        seen = seen_at(grid, self.view(places, grid.shape[3] / grid.shape[2])[..., :2])
        return seen if self.ground is None else torch.cat([seen, self.ground(grid, places)], 2)


def form_loss(predicted: Form, true: Form) -> Tensor:
    """How far off agents and nodes are, `[B]`: by the distance, and not its square."""
    agents, nodes = (
        functional.smooth_l1_loss(mine, real, beta=0.05, reduction="none").flatten(1).mean(1)
        for mine, real in zip(predicted, true, strict=True)
    )
    return nodes + 0.5 * agents
