"""Finds points in a latent frame: where each is, and what it looks like."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.layers import Look

AVERAGE_CELLS = 32
"""Cells per side in which the average frame is kept. Every size that divides it is kept exactly."""

REACH = 0.2
"""How far a point may lie from where its cells are on average; a picture is 2 wide."""

FLOOR = 0.03
"""Share of the mean salience of a frame that a cell has in which nothing differs from the average
frame."""


class PointSight(Look):
    """Reads K points from a latent frame: two coordinates and some features each.

    A point is the mean of the cells it looks at, a softmax over cells (Finn et al. 2016, arXiv
    1509.06113), moved a little by what these show. It looks where the frame differs from the
    average frame of the data, because there things move; so a camera has to stand still.

    Args:
        latent_channels: channels C of the codec.
        points: number of points K.
        features: number of features F of each, between −1 and 1.
        channels: channels of its convolutions.
    """

    average: Tensor

    def __init__(
        self, latent_channels: int, points: int, features: int, channels: int = 48
    ) -> None:
        super().__init__(2 * latent_channels + 2, channels)
        self.points, self.entries = points, 2 + features
        kept = torch.zeros(latent_channels, AVERAGE_CELLS, AVERAGE_CELLS)
        self.register_buffer("average", kept)
        self.where = nn.Conv2d(channels, points, 1)
        self.what = nn.Conv2d(channels, points * self.entries, 1)
        nn.init.normal_(self.where.weight, std=2 / math.sqrt(channels))  # they begin apart

    def measure(self, average: Tensor) -> None:
        """Take the average latent frame `[C, h, w]` of the data."""
        self.average.copy_(functional.interpolate(average[None], self.average.shape[1:])[0])

    def forward(self, frame: Tensor) -> Tensor:
        """The points `[B, K, 2 + F]` in a latent frame `[B, C, h, w]`."""
        size = frame.shape[-2], frame.shape[-1]
        average = functional.adaptive_avg_pool2d(self.average, size)
        cells = cell_places(size, frame)
        inputs = [frame, frame - average, cells.expand(len(frame), -1, -1, -1)]
        inputs = torch.cat(inputs, 1).contiguous(memory_format=torch.channels_last)
        grid = self.features(inputs)
        change = (frame - average).float().square().mean(1).flatten(1)
        salience = change / (change.mean(1, keepdim=True) + 1e-6)
        logits = self.where(grid).flatten(2).float() + (salience + FLOOR).log()[:, None]
        looks = logits.softmax(-1)
        entries = self.what(grid).unflatten(1, (self.points, self.entries)).flatten(3).float()
        entries = torch.tanh((entries * looks[:, :, None]).sum(-1))
        places = looks @ cells.flatten(1).t().float() + REACH * entries[..., :2]
        return torch.cat([places, entries[..., 2:]], -1)


def cell_places(size: torch.Size | tuple[int, ...], like: Tensor) -> Tensor:
    """Coordinates (x, y) of the middles of cells, `[2, h, w]`; a picture is from −1 to 1."""
    height, width = size
    rows = (2 * torch.arange(height, device=like.device, dtype=like.dtype) + 1) / height - 1
    columns = (2 * torch.arange(width, device=like.device, dtype=like.dtype) + 1) / width - 1
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"))
