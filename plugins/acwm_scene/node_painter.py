"""Paints agents and nodes where they are seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from acwm_scene.layers import Painter
from acwm_scene.nodes import Form, NodeLayout, View, along_sides, facing, seen_at
from acwm_scene.poses import waves, waves_size
from acwm_scene.splatting import Splatting

VALUES = 8
"""Values that a node or an agent tells the pixels where it is."""

OCTAVES = 3

INSIDE = 3
"""Octaves of the Fourier features of a place in its cell; the longest wave has two cells."""

LOOK = 16
"""Values that tell how a node or an agent looks."""


class NodeMap(nn.Module):
    """A map of what is where: what nodes and agents tell the cells that they are seen in.

    Args:
        layout: of the nodes.
        view: the camera.
        light: direction to the light whose shadows on the ground it shows, if any.
        stride: video frames per latent frame.
        channels: channels of the map.
    """

    def __init__(
        self,
        layout: NodeLayout,
        view: View,
        light: Sequence[float] | None,
        *,
        stride: int,
        channels: int,
    ) -> None:
        super().__init__()
        self.layout, self.view = layout, view
        axes, sides, count = layout.axes, len(layout.shape), math.prod(layout.shape)
        place = waves_size(axes, OCTAVES) + (stride - 1) * axes
        turned = layout.facing_size + 2 * sides * axes
        self.node = nn.Sequential(
            nn.Linear(place + turned + 2 * LOOK, 2 * channels),
            nn.SiLU(),
            nn.Linear(2 * channels, VALUES),
        )
        self.agent = nn.Sequential(
            nn.Linear(place + LOOK, channels), nn.SiLU(), nn.Linear(channels, VALUES)
        )
        self.node_look = nn.Parameter(0.3 * torch.randn(count, LOOK))
        self.agent_look = nn.Parameter(0.3 * torch.randn(layout.agents, LOOK))
        self.splat = Splatting(layout, view, light, frames=stride, values=VALUES)
        self.mix = nn.Linear(self.splat.channels, channels)

    def forward(self, form: Form, looks: Tensor, size: torch.Size) -> Tensor:
        """The map `[B, channels, *size]` of forms in some video frames, the last one first.

        `looks`, `[B, N, LOOK]`, is how the given frame shows each node.
        """
        now = form.nodes[:, 0]
        looks = torch.cat([looks, self.node_look.expand(len(looks), -1, -1)], -1)
        turned = [sides := along_sides(now, self.layout.shape)]
        if self.layout.facing_size:
            turned.append(facing(now, sides, self.view.eye))
        nodes = self.node(self._told(form.nodes, [*turned, looks]))
        agents = self.agent(self._told(form.agents, [self.agent_look.expand(len(now), -1, -1)]))
        cells = self.splat(form, nodes.float(), agents.float(), size)
        return self.mix(cells).transpose(1, 2).unflatten(2, size)

    def _told(self, places: Tensor, further: list[Tensor]) -> Tensor:
        """What is known of things at `[B, frames, N, D]`, of which the last frame is the first."""
        now = places[:, 0]
        before = (now[:, None] - places[:, 1:]).permute(0, 2, 1, 3).flatten(2)
        return torch.cat([waves(now / 2, OCTAVES), before, *further], -1)


class NodePainter(Painter):
    """Paints what moved where it is now.

    Args:
        layout: of the nodes.
        view: the camera.
        light: see `NodeMap`.
        stride: video frames per latent frame; a latent frame shows how things move within it.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by; it is the same for all frames.
    """

    def __init__(
        self,
        layout: NodeLayout,
        view: View,
        light: Sequence[float] | None,
        *,
        stride: int,
        channels: int,
        width: int,
    ) -> None:
        super().__init__(channels, channels)
        self.map = NodeMap(layout, view, light, stride=stride, channels=channels)
        self.view = view
        self.look = nn.Sequential(
            nn.Linear(channels + waves_size(2, INSIDE) - 2, channels),
            nn.SiLU(),
            nn.Linear(channels, LOOK),
        )
        self.vector = nn.Parameter(torch.zeros(width))

    def looks(self, features: Tensor, nodes: Tensor) -> Tensor:
        """How the given frame shows each node, `[B, N, LOOK]`.

        A node takes its look along wherever it moves, as the stripe of a rope does.

        Args:
            features: of the cells of the frame, `[B, channels, h, w]`.
            nodes: places in it, `[B, N, D]`.
        """
        height, width = features.shape[-2:]
        spots = self.view(nodes, width / height)[..., :2]
        inside = spots * spots.new_tensor([width / 2, height / 2])  # in cells
        seen = seen_at(features.float(), spots)
        return self.look(torch.cat([seen, waves(4 * inside, INSIDE)[..., 2:]], -1))
