"""Finds agents as spots in a latent frame."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from acwm_recurrent.nodes import NodeLayout, View, seen_at

NEAR = 64
"""Channels of what a cell and those around it show."""

ASIDE, APART = 0.1, 2.0
"""Scales of the way from a spot to its agent, in pictures and in units along the line of sight."""


class AgentSight(nn.Module):
    """Finds agents in the picture by what a cell and those around it show, and nothing else.

    So it knows a gripper by its colour, and not by the side on which it was in the training.

    Args:
        latent_channels: channels C of the latent.
        layout: of agents and nodes.
        view: the camera.
        hidden: size of what is known of the whole frame.
    """

    def __init__(self, latent_channels: int, layout: NodeLayout, view: View, hidden: int) -> None:
        super().__init__()
        self.view = view
        self.near = nn.Sequential(
            # Zeros around the frame would tell where a cell is.
            nn.Conv2d(latent_channels, NEAR, 3, padding=1, padding_mode="replicate"),
            nn.SiLU(),
            nn.Conv2d(NEAR, NEAR, 1),
            nn.SiLU(),
        )
        self.spot = nn.Conv2d(NEAR, layout.agents, 1, bias=False)
        self.shift = nn.Sequential(nn.Linear(NEAR, NEAR), nn.SiLU(), nn.Linear(NEAR, layout.axes))
        self.far = nn.Linear(hidden, layout.agents) if layout.axes == 3 else None

    def forward(self, frame: Tensor, hidden: Tensor) -> Tensor:
        """Where agents are, `[B, A, D]` in units.

        Args:
            frame: a latent frame, `[B, C, h, w]`.
            hidden: what is known of all of it, `[B, hidden]`; it tells how far away agents are.
        """
        near, aspect = self.near(frame), frame.shape[3] / frame.shape[2]
        spots = self._shares(near) @ cell_places(frame)
        shift = self.shift(seen_at(near.float(), spots)).float()
        spots = spots + ASIDE * shift[..., :2]
        if self.far is None:
            return self.view.on_ground(spots, aspect)
        far = shift[..., 2:] + self.far(hidden).float()[..., None]
        seen = torch.cat([spots, self.view.eye.norm() + APART * far], -1)
        return self.view.places(seen, aspect)

    def stray(self, frame: Tensor, true: Tensor) -> Tensor:
        """How far from agents `[B, A, D]` the cells are that it takes for them, in pictures."""
        spots = self.view(true, frame.shape[3] / frame.shape[2])[:, :, None, :2]
        away = (cell_places(frame) - spots).norm(dim=-1)
        return (self._shares(self.near(frame)) * away).sum(-1).mean()

    def _shares(self, near: Tensor) -> Tensor:
        """How likely each agent is in each cell, `[B, A, h · w]`."""
        return self.spot(near).flatten(2).float().softmax(-1)


def cell_places(frame: Tensor) -> Tensor:
    """The middle of each cell, `[h · w, 2]`: right and down in −1 to 1."""
    across = [(2 * torch.arange(n, device=frame.device) + 1) / n - 1 for n in frame.shape[2:]]
    down, right = torch.meshgrid(*across, indexing="ij")
    return torch.stack([right, down], -1).flatten(0, 1)
