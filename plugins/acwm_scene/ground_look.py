"""Looks at the ground: how far away something is, a picture tells by its shadow."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from acwm_scene.nodes import View, seen_at


def shadows_of(places: Tensor, light: Tensor) -> Tensor:
    """Where the shadows of places `[…, 3]` fall on the ground z = 0."""
    return places - places[..., 2:] / light[2] * light


class GroundLook(nn.Module):
    """What a frame shows on the ground below a place, and where its shadow would fall.

    Mirrored frames (`data.symmetries`) are lit from the other side, so it looks there as well.

    Args:
        view: the camera.
        light: direction to the light, if there is one.

    Attributes:
        looks: how many cells it looks at, for each place.
    """

    lights: Tensor

    def __init__(self, view: View, light: Sequence[float] | None) -> None:
        super().__init__()
        lights = torch.zeros(0, 3)
        if light is not None:
            here = torch.tensor(light, dtype=torch.float32)
            lights = torch.stack([here, here * torch.tensor([-1.0, 1.0, 1.0])])
        self.view, self.looks = view, 1 + len(lights)
        self.register_buffer("lights", lights, persistent=False)

    def forward(self, grid: Tensor, places: Tensor) -> Tensor:
        """Map features of cells `[B, C, h, w]` and places `[B, N, 3]` to `[B, N, looks · C]`."""
        aspect = grid.shape[3] / grid.shape[2]
        below = [places[..., :2], *(shadows_of(places, light) for light in self.lights.unbind())]
        return torch.cat([seen_at(grid, self.view(spots, aspect)[..., :2]) for spots in below], 2)
