"""Paints points as Gaussians with their features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from acwm_scene.layers import Painter
from acwm_scene.point_sight import cell_places

WIDTHS = 0.13, 0.35
"""Initial widths of the near and the far Gaussian of a point; a picture is 2 wide."""


class PointPainter(Painter):
    """Paints a map of points, and a vector of all of them that modulates the blocks.

    Args:
        points: number of points K.
        features: number of features F of each.
        channels: channels of the grid.
        width: size of the vector.
    """

    def __init__(self, points: int, features: int, *, channels: int, width: int) -> None:
        super().__init__(points * (2 * (1 + features) + 2), channels)
        self.log_widths = nn.Parameter(torch.tensor(WIDTHS).log().expand(points, 2).clone())
        self.tell = nn.Sequential(
            nn.Linear(2 * points * (2 + features), width), nn.SiLU(), nn.Linear(width, width)
        )

    def map(self, points: Tensor, size: torch.Size) -> Tensor:
        """A map `[B, channels, h, w]` of points `[B, K, 2 + F]`.

        Of each point a near and a far Gaussian, alone and times each feature; and the direction to
        the point, within the far one.
        """
        cells = cell_places(size, points).flatten(1).t()
        apart = cells - points[:, :, None, :2]
        squares = apart.square().sum(-1)
        doubled = 2 * torch.exp(2 * self.log_widths)
        near, far = (torch.exp(-squares / widths[:, None]) for widths in doubled.unbind(1))
        values = torch.cat([torch.ones_like(points[..., :1]), points[..., 2:]], -1)[..., None]
        slope = (far[..., None] * apart / WIDTHS[1]).transpose(2, 3)
        grid = torch.cat([near[:, :, None] * values, far[:, :, None] * values, slope], 2)
        return grid.flatten(1, 2).unflatten(2, tuple(size))
