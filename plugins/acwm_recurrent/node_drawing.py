"""Draws a latent frame from the given one and from where agents and nodes are."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from acwm_recurrent.layers import FrameDrawing
from acwm_recurrent.nodes import Form, NodeLayout, View, along_sides, facing, seen_at
from acwm_recurrent.poses import waves, waves_size
from acwm_recurrent.splatting import Splatting

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
        heard = self.splat(form, nodes.float(), agents.float(), size)
        return self.mix(heard).transpose(1, 2).unflatten(2, size)

    def _told(self, places: Tensor, further: list[Tensor]) -> Tensor:
        """What is known of things at `[B, frames, N, D]`, of which the last frame is the first."""
        now = places[:, 0]
        before = (now[:, None] - places[:, 1:]).permute(0, 2, 1, 3).flatten(2)
        return torch.cat([waves(now / 2, OCTAVES), before, *further], -1)


class NodeDrawing(FrameDrawing):
    """Draws frames: the given one, with what moved where it is now.

    Args:
        latent_channels: channels C of the latent.
        layout: of the nodes.
        view: the camera.
        light: see `NodeMap`.
        stride: video frames per latent frame; a latent frame shows how things move within it.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by; it is the same for all frames.
        blocks: number of residual blocks.
    """

    def __init__(
        self,
        latent_channels: int,
        layout: NodeLayout,
        view: View,
        light: Sequence[float] | None,
        *,
        stride: int,
        channels: int,
        width: int,
        blocks: int,
    ) -> None:
        super().__init__(latent_channels, channels, channels=channels, width=width, blocks=blocks)
        self.map = NodeMap(layout, view, light, stride=stride, channels=channels)
        self.view = view
        self.look = nn.Sequential(
            nn.Linear(channels + waves_size(2, INSIDE) - 2, channels),
            nn.SiLU(),
            nn.Linear(channels, LOOK),
        )
        self.vector = nn.Parameter(torch.zeros(width))

    def canvas(self, base: Tensor, form: Form) -> tuple[Tensor, Tensor]:
        """What all frames start from: the given frame and its form, and how it shows each node.

        A node takes its look along wherever it moves, as the stripe of a rope does.

        Args:
            base: the given latent frame, `[B, C, h, w]`.
            form: in its last video frames, as in `forward`.

        Returns:
            `[B, channels, h, w]` and `[B, N, LOOK]`.
        """
        grid, (height, width) = self.stem(base), base.shape[-2:]
        spots = self.view(form.nodes[:, 0], width / height)[..., :2]
        inside = spots * spots.new_tensor([width / 2, height / 2])  # in cells
        seen = torch.cat([seen_at(grid.float(), spots), waves(4 * inside, INSIDE)[..., 2:]], -1)
        looks = self.look(seen)
        return grid + self.then(self.map(form, looks, base.shape[-2:])), looks

    def forward(self, canvas: Tensor, looks: Tensor, form: Form) -> Tensor:
        """The change of the given latent frame, `[B, C, h, w]`.

        Args:
            canvas: see `canvas`.
            looks: see `canvas`.
            form: in the video frames of the latent frame, the last one first: `[B, stride, …]`.
        """
        return self.change(
            canvas, self.map(form, looks, canvas.shape[-2:]), self.vector.expand(len(canvas), -1)
        )
