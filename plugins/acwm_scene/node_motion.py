"""How actions move agents, and agents move the nodes of a rope or a cloth."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from acwm_scene.nodes import Form, NodeBlock, NodeLayout, ahead_of, along_sides, seen_from
from acwm_scene.poses import waves, waves_size

NEAR = 5
"""Octaves of the Fourier features of the distance to an agent."""

WIDE = {2: 3, 3: 5}
"""Octaves of those of a place in the world, in the plane and in space, where the ground is near."""

WORLD = 2.0
"""Units that count as one where a place in the world is told: its longest wave has 16 units."""

STEP = 0.3
"""Scale of a change in a video frame, in units."""

REACHES = {1: (1, 2, 4, 8, 1, 2), 2: (1, 2, 4, 1, 2, 4)}
"""How far the blocks reach along a rope, and across a cloth, which pulls as a whole at once."""


class NodeMotion(nn.Module):
    """Nodes are pushed and held by agents, and pull each other.

    Where there are several agents, all is turned so that the second one is ahead of the first one:
    a cloth hangs from its grippers alike whichever way they stand. In mixed precision only what
    nodes hear of each other is rounded, as places in units would lose millimetres.

    Args:
        layout: of the nodes.
        channels: size of its layers.
        noise: numbers of a draw that the motion depends on; 0 for one future.
    """

    def __init__(self, layout: NodeLayout, channels: int, noise: int = 0) -> None:
        super().__init__()
        self.chance = nn.Linear(noise, channels, bias=False) if noise else None
        self.shape, agents, axes, sides = (
            layout.shape,
            layout.agents,
            layout.axes,
            len(layout.shape),
        )
        inputs = 2 * agents * waves_size(axes, NEAR) + agents * axes + axes
        inputs += waves_size(axes, WIDE[axes]) + 1 + 2 * sides * axes
        self.tell = nn.Linear(inputs, channels)
        self.blocks = nn.ModuleList(NodeBlock(sides, channels, reach) for reach in REACHES[sides])
        self.out = nn.Linear(channels, axes)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.keep = nn.Parameter(torch.tensor(0.5))

    def forward(
        self, form: Form, agents: Tensor, change: Tensor, chance: tuple[Tensor, ...] = ()
    ) -> tuple[Tensor, Tensor]:
        """Move the nodes by one frame, while agents move from `form.agents` to `agents`.

        Args:
            form: where things are.
            agents: where the agents are a frame later, `[B, A, D]`.
            change: of the nodes since the frame before, `[B, N, D]`.
            chance: `[B, noise]`, of a model that draws.

        Returns:
            The new places, and their change.
        """
        if agents.shape[1] == 1:
            change = self._changed(form, agents, change, chance)
        else:
            ahead = ahead_of(form.agents)
            seen = Form(*(seen_from(ahead, places) for places in form))
            agents, change = (seen_from(ahead, places) for places in (agents, change))
            back = ahead * ahead.new_tensor([1.0, -1.0])
            change = seen_from(back, self._changed(seen, agents, change, chance))
        return form.nodes + change, change

    def _changed(
        self, form: Form, agents: Tensor, change: Tensor, chance: tuple[Tensor, ...]
    ) -> Tensor:
        nodes, exact = form.nodes, torch.autocast(agents.device.type, enabled=False)
        away = [
            waves(places[:, None, number] - nodes, NEAR)
            for places in (form.agents, agents)
            for number in range(agents.shape[1])
        ]
        moved = ((agents - form.agents) / STEP).flatten(1)[:, None].expand(-1, nodes.shape[1], -1)
        inputs = [
            *away,
            moved,
            change / STEP,
            waves(nodes / WORLD, WIDE[nodes.shape[2]]),
            torch.ones_like(nodes[..., :1]),
            along_sides(nodes, self.shape),
        ]
        with exact:
            features = self.tell(torch.cat(inputs, -1))
            if self.chance:
                features = features + self.chance(*chance)[:, None]
        for block in self.blocks:
            features = block(features, self.shape)
        with exact:
            step = self.out(nn.functional.silu(features.float()))
        return self.keep * change + STEP * step
