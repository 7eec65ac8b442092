"""How actions move agents, and agents move the nodes of a rope or a cloth."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from acwm_recurrent.nodes import Form, NodeBlock, NodeLayout, along_sides
from acwm_recurrent.poses import waves, waves_size

NEAR, WIDE = 5, 3
"""Octaves of the Fourier features of the distance to an agent, and of a place in the world."""

WORLD = 2.0
"""Units that count as one where a place in the world is told: its longest wave has 16 units."""

STEP = 0.3
"""Scale of a change in a video frame, in units."""

REACHES = {1: (1, 2, 4, 8, 1, 2), 2: (1, 2, 4, 1, 2, 4)}
"""How far the blocks reach along a rope, and across a cloth, which pulls as a whole at once."""


class NodeMotion(nn.Module):
    """Nodes are pushed and held by agents, and pull each other.

    Args:
        layout: of the nodes.
        channels: size of its layers.
    """

    def __init__(self, layout: NodeLayout, channels: int) -> None:
        super().__init__()
        self.shape, agents, axes, sides = (
            layout.shape,
            layout.agents,
            layout.axes,
            len(layout.shape),
        )
        told = 2 * agents * waves_size(axes, NEAR) + agents * axes + axes
        told += waves_size(axes, WIDE) + 1 + 2 * sides * axes
        self.tell = nn.Linear(told, channels)
        self.blocks = nn.ModuleList(NodeBlock(sides, channels, each) for each in REACHES[sides])
        self.out = nn.Linear(channels, axes)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.keep = nn.Parameter(torch.tensor(0.5))

    def forward(self, form: Form, agents: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """Move the nodes by one frame, while agents move from `form.agents` to `agents`.

        Args:
            form: where things are.
            agents: where the agents are a frame later, `[B, A, D]`.
            change: of the nodes since the frame before, `[B, N, D]`.

        Returns:
            The new places, and their change.
        """
        nodes = form.nodes
        away = [
            waves(each[:, None, number] - nodes, NEAR)
            for each in (form.agents, agents)
            for number in range(agents.shape[1])
        ]
        moved = ((agents - form.agents) / STEP).flatten(1)[:, None].expand(-1, nodes.shape[1], -1)
        told = [
            *away,
            moved,
            change / STEP,
            waves(nodes / WORLD, WIDE),
            torch.ones_like(nodes[..., :1]),
            along_sides(nodes, self.shape),
        ]
        features = self.tell(torch.cat(told, -1))
        for block in self.blocks:
            features = block(features, self.shape)
        change = self.keep * change + STEP * self.out(nn.functional.silu(features))
        return nodes + change, change
