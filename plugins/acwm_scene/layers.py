"""Layers that models share: convolutions whose weights Muon can update, and what they make up."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

KERNEL = 3

START_GATE = 0.3
"""Initial weight of a block's residual branch."""

CELLS, COARSE = 4, 32
"""Cells per side that a whole frame is summed up in, and values of each."""


class MatrixConv(nn.Module):
    """A 3×3 convolution whose weight is one matrix, `[out, in · 9]`, as Muon requires.

    Args:
        inputs: channels of the input.
        outputs: channels of the output.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.inputs = inputs
        fan_in = inputs * KERNEL**2
        self.weight = nn.Parameter(torch.randn(outputs, fan_in) / math.sqrt(fan_in))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, grid: Tensor) -> Tensor:
        """Map `[B, in, h, w]` to `[B, out, h, w]`, with zero padding."""
        kernel = self.weight.unflatten(1, (KERNEL, KERNEL, self.inputs)).permute(0, 3, 1, 2)
        return functional.conv2d(grid, kernel, self.bias, padding=KERNEL // 2)


class FilmBlock(nn.Module):
    """A residual block of two convolutions, modulated by a vector.

    FiLM (Perez et al. 2018, arXiv 1709.07871): the vector scales and shifts the normalised input,
    and gates the branch.

    Args:
        channels: channels of the grid.
        width: size of the vector.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.first = MatrixConv(channels, channels)
        self.second = MatrixConv(channels, channels)
        self.film = nn.Linear(width, 3 * channels)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)
        nn.init.constant_(self.film.bias[2 * channels :], START_GATE)

    def forward(self, grid: Tensor, vector: Tensor) -> Tensor:
        """Map a grid `[B, C, h, w]` and a vector `[B, width]` to a grid `[B, C, h, w]`."""
        scale, shift, gate = self.film(vector)[..., None, None].chunk(3, 1)
        branch = self.first(channel_norm(grid) * (1 + scale) + shift)
        return grid + gate * self.second(functional.silu(branch))


class FrameDrawing(nn.Module):
    """Draws latent frames on a canvas, from what painters add to a map of this frame.

    Args:
        latent_channels: channels C of the latent.
        channels: channels of the grid.
        width: size of the vector that the blocks are modulated by.
        blocks: number of residual blocks.

    Attributes:
        stem: maps the given latent frame to the features of its cells.
    """

    def __init__(self, latent_channels: int, *, channels: int, width: int, blocks: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(latent_channels, channels, 3, padding=1)
        self.blocks = nn.ModuleList(FilmBlock(channels, width) for _ in range(blocks))
        self.head = MatrixConv(channels, channels)
        self.out = nn.Conv2d(channels, latent_channels, 1)
        for parameter in self.out.parameters():
            nn.init.zeros_(parameter)

    def forward(self, canvas: Tensor, now: Tensor, vector: Tensor) -> Tensor:
        """The change of the given latent frame, `[B, C, h, w]`.

        Args:
            canvas: what all frames start from, `[B, channels, h, w]`.
            now: what painters add of this frame, `[B, channels, h, w]`.
            vector: what the blocks are modulated by, `[B, width]`.
        """
        grid = (canvas + now).contiguous(memory_format=torch.channels_last)
        for block in self.blocks:
            grid = block(grid, vector)
        return self.out(functional.silu(self.head(channel_norm(grid))))


class Painter(nn.Module):
    """What painters of all groups have: maps of the given frame and of another one, side by side.

    Args:
        mapped: channels of the maps.
        channels: channels of the grid that is drawn on.
    """

    def __init__(self, mapped: int, channels: int) -> None:
        super().__init__()
        self.then, self.now = (nn.Conv2d(mapped, channels, 1) for _ in range(2))


class Look(nn.Module):
    """Features of the cells of a latent frame, for what is read from them.

    Args:
        latent_channels: channels C of the latent.
        channels: channels of its convolutions.
    """

    def __init__(self, latent_channels: int, channels: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(latent_channels, channels, 3, padding=1)
        self.layers = nn.ModuleList(
            nn.Sequential(
                nn.GroupNorm(1, channels),
                nn.Conv2d(channels, channels, 3, padding=1),
                nn.SiLU(),
                nn.Conv2d(channels, channels, 3, padding=1),
            )
            for _ in range(3)
        )

    def features(self, frame: Tensor) -> Tensor:
        """Map a latent frame `[B, C, h, w]` to `[B, channels, h, w]`."""
        grid = self.stem(frame)
        for layer in self.layers:
            grid = grid + layer(grid)
        return functional.silu(grid)


class Overview(Look):
    """A look that sums up the whole frame.

    By where things are, a softmax over the cells for each of `points` (Finn et al. 2016, arXiv
    1509.06113), and by what coarse cells show.

    Args:
        latent_channels: channels C of the latent.
        channels: channels of its convolutions.
        points: number of places in the picture that the summary has.

    Attributes:
        size: number of values of `summary`.
    """

    def __init__(self, latent_channels: int, channels: int, points: int) -> None:
        super().__init__(latent_channels, channels)
        self.where = nn.Conv2d(channels, points, 1)
        self.what = nn.Conv2d(channels, COARSE, 1)
        self.size = 2 * points + COARSE * CELLS**2

    def summary(self, grid: Tensor) -> Tensor:
        """What features of the cells `[B, channels, h, w]` say of the whole frame, `[B, size]`."""
        height, width = grid.shape[2:]
        looks = self.where(grid).flatten(2).float().softmax(-1).unflatten(2, (height, width))
        rows, columns = (
            torch.linspace(-1, 1, size, device=grid.device) for size in (height, width)
        )
        places = torch.cat([looks.sum(3) @ rows[:, None], looks.sum(2) @ columns[:, None]], 2)
        cells = functional.adaptive_avg_pool2d(self.what(grid), CELLS)
        return torch.cat([places.flatten(1), cells.flatten(1)], 1)


def channel_norm(grid: Tensor) -> Tensor:
    """Layer norm without weights over the channels of each cell, `[B, C, h, w]`."""
    normed = functional.layer_norm(grid.permute(0, 2, 3, 1), grid.shape[1:2])
    return normed.permute(0, 3, 1, 2)
