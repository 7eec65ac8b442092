"""Paints agents and bodies: what is where, as a map."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.layers import Painter
from acwm_scene.poses import Poses, waves, waves_size

OCTAVES = 5
"""Octaves of the Fourier features of a place."""


class ThingMap(nn.Module):
    """A map of what is where: a grid of features, the sum over things of what each is to each cell.

    Args:
        things: number of things K, each with its own look.
        extra: number of further values that tell of a thing.
        channels: channels of the map.
    """

    def __init__(self, things: int, extra: int, channels: int) -> None:
        super().__init__()
        size = waves_size(2, OCTAVES)
        self.cell = nn.Linear(size, channels)
        self.thing = nn.Linear(size + extra, channels)
        self.mix = nn.Linear(channels, channels)
        self.look = nn.Parameter(0.3 * torch.randn(things, channels))

    def forward(self, places: Tensor, extra: Tensor, there: Tensor, cells: Tensor) -> Tensor:
        """The map of things that are there or not, `[B, channels, cells]`.

        Args:
            places: of the things in units, `[B, K, 2]`.
            extra: `[B, K, extra]`.
            there: 1 or 0, `[B, K, 1]`.
            cells: places of the cells, `[cells, 2]`.
        """
        things = self.thing(torch.cat([waves(places, OCTAVES), extra], -1))
        # A product of waves of the same length knows how far apart they are.
        both = self.cell(waves(cells, OCTAVES)) * things[:, :, None]
        looks = functional.silu(self.mix(both) + self.look[:, None])
        return (looks * there[:, :, None]).sum(1).transpose(1, 2)


class BodyPainter(Painter):
    """Paints each thing where it was and where it is.

    Args:
        agents: number of agents.
        bodies: number of bodies.
        stride: video frames per latent frame; a latent frame shows how things move within it.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by; it is the same for all frames.
    """

    def __init__(self, agents: int, bodies: int, *, stride: int, channels: int, width: int) -> None:
        super().__init__(2 * channels, channels)
        before = stride - 1
        self.agents = ThingMap(agents, 2 * before, channels)
        self.bodies = ThingMap(bodies, 2 + 4 * before, channels)
        self.vector = nn.Parameter(torch.zeros(width))

    def map(self, poses: Poses, cells: Tensor, size: torch.Size) -> Tensor:
        """What is where, `[B, 2 · channels, *size]`.

        Args:
            poses: in the video frames of a latent frame, the last one first: `[B, stride, …]`.
            cells: places of the cells, `[h w, 2]`.
            size: rows and columns of cells.
        """
        agents, places, turns = (
            values.unbind(1) for values in (poses.agents, poses.places, poses.turns)
        )
        seen = torch.ones_like(agents[0][..., :1])
        earlier = [
            torch.cat(_changes(frames), -1) for frames in (agents, places, turns) if frames[1:]
        ]
        of_agents = earlier[:1] or [agents[0][..., :0]]
        present = poses.present[:, 0]
        maps = [
            self.agents(agents[0], of_agents[0], seen, cells),
            self.bodies(places[0], torch.cat([turns[0], *earlier[1:]], -1), present, cells),
        ]
        return torch.cat(maps, 1).unflatten(2, size)


def _changes(frames: tuple[Tensor, ...]) -> list[Tensor]:
    """How the last frame, which is the first of these, differs from each earlier one."""
    return [frames[0] - earlier for earlier in frames[1:]]
