"""Reads where agents and nodes are from a latent frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_recurrent.agent_sight import AgentSight
from acwm_recurrent.layers import Overview
from acwm_recurrent.nodes import (
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
from acwm_recurrent.poses import waves, waves_size

POINTS, HIDDEN, OCTAVES = 32, 256, 3

ROUNDS = 3
"""How often it looks again where it thinks that things are."""

SPREAD = 4.0
"""Scale of the first guess, in units."""


class NodeSight(Overview):
    """Guesses from the whole frame where things are, then looks there and corrects itself.

    So a snake finds a contour (Kass et al. 1988): what the picture shows at each node, and where
    its neighbours are, tell where it should move. The nodes of a rope are kept at equal distances.

    Args:
        latent_channels: channels C of the latent.
        layout: of the nodes.
        view: the camera.
        channels: channels of its convolutions.
    """

    def __init__(self, latent_channels: int, layout: NodeLayout, view: View, channels: int) -> None:
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
        self.agents = AgentSight(latent_channels, layout, view, HIDDEN)
        place = waves_size(axes, OCTAVES)
        self.agent = nn.Sequential(
            nn.Linear(channels + place, channels), nn.SiLU(), nn.Linear(channels, axes)
        )
        self.tell = nn.Linear(channels + place + 2 * sides * axes, channels)
        self.blocks = nn.ModuleList(NodeBlock(sides, channels, each) for each in (1, 2, 4))
        self.shift = nn.Linear(channels, axes)

    def forward(self, frame: Tensor) -> list[Form]:
        """The forms that a latent frame `[B, C, h, w]` shows: the first guess to the last one."""
        grid = self.features(frame)
        hidden = self.guess(self.summary(grid))
        agents = self.agents(frame, hidden)
        forms = [Form(agents, self._guessed(hidden, agents))]
        for _ in range(ROUNDS):
            forms.append(self._corrected(grid.float(), forms[-1]))
        return forms

    def _guessed(self, hidden: Tensor, agents: Tensor) -> Tensor:
        """A first guess of the nodes, as they are seen from the agents where there are several."""
        nodes = SPREAD * self.guess_nodes(hidden).float().unflatten(1, (-1, self.layout.axes))
        if agents.shape[1] > 1:
            agents = agents.detach()  # they are not learned by what hangs from them
            back = ahead_of(agents) * agents.new_tensor([1.0, -1.0])
            nodes = agents.mean(1, keepdim=True) + seen_from(back, nodes)
        return self._evenly(nodes)

    def _corrected(self, grid: Tensor, form: Form) -> Form:
        agents, nodes = (each.detach() for each in form)  # where it looks is not learned by looking
        seen, shown = self._seen(grid, agents), self._seen(grid, nodes)
        shift = self.agent(torch.cat([seen, waves(agents / 2, OCTAVES)], -1))
        sides = along_sides(nodes, self.layout.shape)
        features = self.tell(torch.cat([shown, waves(nodes / 2, OCTAVES), sides], -1))
        for block in self.blocks:
            features = block(features, self.layout.shape)
        moved = form.nodes + self.shift(functional.silu(features)).float()
        return Form(form.agents + shift.float(), self._evenly(moved))

    def _evenly(self, nodes: Tensor) -> Tensor:
        return evenly(nodes) if len(self.layout.shape) == 1 else nodes

    def _seen(self, grid: Tensor, places: Tensor) -> Tensor:
        """What the frame shows at places `[B, N, D]`: `[B, N, channels]`."""
        return seen_at(grid, self.view(places, grid.shape[3] / grid.shape[2])[..., :2])


def form_loss(made: Form, true: Form) -> Tensor:
    """How far off agents and nodes are, `[B]`: by the distance, and not its square."""
    agents, nodes = (
        functional.smooth_l1_loss(mine, real, beta=0.05, reduction="none").flatten(1).mean(1)
        for mine, real in zip(made, true, strict=True)
    )
    return nodes + 0.5 * agents
