"""Finds agents as spots in a latent frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from acwm_scene.ground_look import GroundLook
from acwm_scene.nodes import NodeLayout, View, seen_at
from acwm_scene.poses import waves, waves_size

NEAR = 64
"""Channels of what a cell and those around it show."""

ASIDE, APART = 0.1, 2.0
"""Scales of the way from a spot to its agent, in pictures and in units along the line of sight."""

DISTANCES = (-12.0, 8.0, 41)
"""Distances that are tried, in units from that of the origin: the first, the last, how many."""

PAIR, OCTAVES = 32, 4
"""Size and octaves of the layer that tells how well the places of two agents fit each other."""

BELOW = -30.0
"""Logit of a distance at which an agent would be below the ground."""


class AgentPlaces(NamedTuple):
    """Where agents seem to be in a latent frame.

    Attributes:
        places: `[B, A, D]` in units.
        cells: logits of the cells that they are seen in, `[B, A, h · w]`.
        distances: logits of the distances that were tried, `[B, A, K]`; K is 0 on the ground.
    """

    places: Tensor
    cells: Tensor
    distances: Tensor


class AgentSight(nn.Module):
    """Finds agents in the picture by what a cell and those around it show, and nothing else.

    So it knows a gripper by its colour, and not by the side on which it was in the training. How
    far away one is that is not on the ground, it finds by search: at each distance, its shadow and
    the ground below it would be elsewhere in the picture.

    Args:
        latent_channels: channels C of the latent.
        layout: of agents and nodes.
        view: the camera.
        light: direction to the light that casts shadows on the ground, if there is one.
    """

    tried: Tensor

    def __init__(
        self, latent_channels: int, layout: NodeLayout, view: View, light: Sequence[float] | None
    ) -> None:
        super().__init__()
        self.view, self.axes = view, layout.axes
        # Zeros around the frame would tell where a cell is.
        self.near = nn.Sequential(
            nn.Conv2d(latent_channels, NEAR, 3, padding=1, padding_mode="replicate"),
            nn.SiLU(),
            nn.Conv2d(NEAR, NEAR, 1),
            nn.SiLU(),
        )
        self.spot = nn.Conv2d(NEAR, layout.agents, 1, bias=False)
        self.shift = nn.Sequential(nn.Linear(NEAR, NEAR), nn.SiLU(), nn.Linear(NEAR, self.axes))
        self.register_buffer("tried", torch.linspace(*DISTANCES), persistent=False)
        if self.axes == 2:
            return
        self.wide = nn.Sequential(
            nn.Conv2d(NEAR, NEAR, 3, padding=1, padding_mode="replicate"),
            nn.SiLU(),
            nn.Conv2d(NEAR, NEAR, 3, padding=1, padding_mode="replicate"),
            nn.SiLU(),
            nn.Conv2d(NEAR, NEAR, 1),
        )
        self.ground = GroundLook(view, light)
        self.match = nn.Sequential(
            nn.Linear((self.ground.looks + 1) * NEAR, NEAR), nn.SiLU(), nn.Linear(NEAR, 1)
        )
        self.pair = None
        if layout.agents > 1:
            features = waves_size(2, OCTAVES)
            self.pair = nn.Sequential(nn.Linear(features, PAIR), nn.SiLU(), nn.Linear(PAIR, 1))

    def forward(self, frame: Tensor) -> AgentPlaces:
        """Where agents are in a latent frame `[B, C, h, w]`."""
        near, aspect = self.near(frame), frame.shape[3] / frame.shape[2]
        cells = self.spot(near).flatten(2).float()
        spots = cells.softmax(-1) @ cell_places(frame.shape[2:], frame.device)
        seen = seen_at(near.float(), spots)
        shift = self.shift(seen).float()
        spots = spots + ASIDE * shift[..., :2]
        if self.axes == 2:
            return AgentPlaces(self.view.on_ground(spots, aspect), cells, cells[..., :0])
        distances = self._distances(near, seen, spots.detach())
        far = (distances.softmax(-1) @ self.tried)[..., None] + APART * shift[..., 2:]
        places = self.view.places(torch.cat([spots, self.view.eye.norm() + far], -1), aspect)
        return AgentPlaces(places, cells, distances)

    def loss(self, located: AgentPlaces, true: Tensor, size: torch.Size) -> Tensor:
        """Cross entropy of the cells and distances of agents `[B, A, D]`, a scalar.

        Args:
            located: by `forward`.
            true: places of the agents.
            size: rows and columns of cells.
        """
        seen = self.view(true, size[1] / size[0])
        inside = (seen[..., :2].abs() <= 1).all(-1)
        away = cell_places(size, true.device) - seen[:, :, None, :2]
        cells_away = (away * away.new_tensor([size[1] / 2, size[0] / 2])).norm(dim=-1)
        loss = (_missed(located.cells, cells_away) * inside).mean()
        if self.axes == 2:
            return loss
        far = seen[..., 2:] - self.view.eye.norm() - self.tried
        return loss + _missed(located.distances, far / (self.tried[1] - self.tried[0])).mean()

    def _distances(self, near: Tensor, seen: Tensor, spots: Tensor) -> Tensor:
        """How well each distance fits what the ground shows, `[B, A, K]`.

        Args:
            near: what cells show, `[B, NEAR, h, w]`.
            seen: what is seen at the agents, `[B, A, NEAR]`.
            spots: where they are in the picture, `[B, A, 2]`.
        """
        aspect, count = near.shape[3] / near.shape[2], len(self.tried)
        tried = (self.view.eye.norm() + self.tried)[:, None].expand(*spots.shape[:2], -1, 1)
        spots, seen = (tensor[:, :, None].expand(-1, -1, count, -1) for tensor in (spots, seen))
        places = self.view.places(torch.cat([spots, tried], -1), aspect)
        below = self.ground((near + self.wide(near)).float(), places.flatten(1, 2))
        fits = self.match(torch.cat([below.unflatten(1, places.shape[1:3]), seen], -1))
        fits = fits.float()[..., 0].masked_fill(places[..., 2] < 0, BELOW)
        return fits if self.pair is None else fits + self._heard(self.pair, fits, places)

    def _heard(self, pair: nn.Module, fits: Tensor, places: Tensor) -> Tensor:
        """What agents hear of each other, `[B, A, K]`: where a cloth is held, both are as high.

        One round of belief propagation.

        Args:
            pair: tells how well two places fit, by how much higher and how far away one is.
            fits: how well each distance fits by itself, `[B, A, K]`.
            places: those that it stands for, `[B, A, K, 3]`.
        """
        apart = places[:, :, None, :, None] - places[:, None, :, None]
        relative = torch.stack([apart[..., 2], apart[..., :2].norm(dim=-1)], -1)
        agreed = pair(waves(relative, OCTAVES)).float()[..., 0]
        messages = (agreed + fits[:, None, :, None]).logsumexp(-1)
        others = 1 - torch.eye(fits.shape[1], device=fits.device)
        return (messages * others[..., None]).sum(2)


def cell_places(size: torch.Size, device: torch.device) -> Tensor:
    """The middle of each of `size` cells, `[h · w, 2]`: right and down in −1 to 1."""
    across = [(2 * torch.arange(n, device=device) + 1) / n - 1 for n in size]
    down, right = torch.meshgrid(*across, indexing="ij")
    return torch.stack([right, down], -1).flatten(0, 1)


def _missed(logits: Tensor, away: Tensor) -> Tensor:
    """Cross entropy of choices `[…, K]` that are so many steps away from the truth, `[…]`."""
    wanted = (1 - away.abs()).clamp(min=0)
    wanted = wanted / wanted.sum(-1, keepdim=True).clamp(min=1e-3)
    return -(wanted * logits.log_softmax(-1)).sum(-1)
