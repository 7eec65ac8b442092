"""Pictures of a rope or a cloth that are finer than the cells of a latent frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_scene.ground_look import shadows_of
from acwm_scene.nodes import Form, NodeLayout, View

FINE = 4
"""Pixels along each side of a cell."""

POINTS = 3
"""Points from one node to the next; about as many as there are pixels between them."""

TEXTURE = 4
"""Values of each point that are learned, and the same in all clips."""

KNOWN = 2
"""Values of each pixel beside those that are told: how far what it shows is, and its cover."""

FRONT = 0.7
"""How much nearer, in units, a point is that hides most of another."""


class Splatting(nn.Module):
    """Splats points between the nodes onto the picture, those in front before those behind.

    What a node tells is seen where the node is to a fraction of a pixel, whichever cell that is in,
    and what is hidden stays hidden (softmax splatting, Niklaus & Liu 2020, arXiv 2003.05534).

    Args:
        layout: of the nodes.
        view: the camera.
        light: direction to the light whose shadows on the ground are shown as well, if any.
        frames: video frames that are shown side by side.
        values: values that each node and agent tells.

    Attributes:
        channels: values that each cell hears.
    """

    def __init__(
        self,
        layout: NodeLayout,
        view: View,
        light: Sequence[float] | None,
        *,
        frames: int,
        values: int,
    ) -> None:
        super().__init__()
        self.shape, self.view = layout.shape, view
        self.light = None if light is None else torch.tensor(light, dtype=torch.float32)
        self.points = tuple((side - 1) * POINTS + 1 for side in layout.shape)
        self.texture = nn.Parameter(0.3 * torch.randn(TEXTURE, *self.points))
        size = values + TEXTURE + KNOWN + (KNOWN if light else 0)
        self.channels = size * frames * FINE**2

    def forward(self, form: Form, nodes: Tensor, agents: Tensor, size: torch.Size) -> Tensor:
        """What cells hear, `[B, cells, channels]`.

        Args:
            form: in some video frames, `[B, T, …]`.
            nodes: what each node tells, `[B, N, values]`.
            agents: what each agent tells, `[B, A, values]`.
            size: rows and columns of cells.
        """
        texture = self.texture.flatten(1).T.expand(len(nodes), -1, -1)
        none = texture.new_zeros(*agents.shape[:2], TEXTURE)
        features = torch.cat([self._between(nodes), texture], 2)
        features = torch.cat([features, torch.cat([agents, none], 2)], 1)
        frames = form.nodes.shape[1]
        points = self._between(form.nodes.flatten(0, 1)).unflatten(0, (-1, frames))
        maps = [self._splatted(torch.cat([points, form.agents], 2), features, size)]
        if self.light is not None:
            fallen = shadows_of(points, self.light.to(points))
            maps.append(self._splatted(fallen, features[:, : fallen.shape[2], :0], size))
        return torch.cat(maps, 2)

    def _between(self, values: Tensor) -> Tensor:
        """Values of the nodes `[B, N, V]` at all points, `[B, P, V]`."""
        mode = ("linear", "bilinear")[len(self.shape) - 1]
        grid = values.float().transpose(1, 2).unflatten(2, self.shape)
        points = functional.interpolate(grid, self.points, mode=mode, align_corners=True)
        return points.flatten(2).transpose(1, 2)

    def _splatted(self, points: Tensor, features: Tensor, size: torch.Size) -> Tensor:
        """What each pixel of the cells shows, `[B, cells, T FINE² (V + KNOWN)]`.

        Args:
            points: places in units, `[B, T, P, D]`.
            features: of each point, `[B, P, V]`.
            size: rows and columns of cells.
        """
        frames, cells = points.shape[1], size[0] * size[1]
        with torch.no_grad():
            pixel, much, depth = self._hit(points, size)
            pixels = torch.zeros_like(points[:, 0, 0, :1]).expand(-1, cells * frames * FINE**2)
            front = (-depth / FRONT).clamp(-20, 20).exp()
            weight = much * front
            total = pixels.scatter_add(1, pixel.flatten(1), weight.flatten(1))
            cover = pixels.scatter_add(1, pixel.flatten(1), much.flatten(1)).clamp(max=1)
            far = pixels.scatter_add(1, pixel.flatten(1), (weight * depth).flatten(1))
            share = cover / (total + 1e-12)
            weight = weight * share.gather(1, pixel.flatten(1)).view_as(weight)
            known = torch.stack([far * share, cover], 2)
        if features.shape[2]:
            values = (weight[..., None] * features[:, None, None]).flatten(1, 3)
            blank = values.new_zeros(len(values), pixels.shape[1], values.shape[2])
            seen = blank.scatter_add(1, pixel.flatten(1)[..., None].expand_as(values), values)
            known = torch.cat([seen, known], 2)
        return known.view(len(points), cells, -1)

    def _hit(self, points: Tensor, size: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
        """The four pixels around each point, how much of it each gets, and the point's depth.

        `[B, T, 4, P]` each. Pixels count cell by cell, and in each cell frame by frame.
        """
        height, width = size[0] * FINE, size[1] * FINE
        seen = self.view(points, size[1] / size[0])
        spots = (seen[..., :2] + 1) * seen.new_tensor([width, height]) / 2 - 0.5
        right, down = torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]], device=points.device)[..., None]
        x, y = (spot[:, :, None].floor() for spot in spots.unbind(-1))
        x, y = x + right, y + down
        much = (1 - (spots[:, :, None, :, 0] - x).abs()) * (1 - (spots[:, :, None, :, 1] - y).abs())
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x, y = (axis.clamp(0, side - 1).long() for axis, side in ((x, width), (y, height)))
        cell = y // FINE * size[1] + x // FINE
        frames = points.shape[1]
        frame = torch.arange(frames, device=points.device)[:, None, None]
        pixel = ((cell * frames + frame) * FINE + y % FINE) * FINE + x % FINE
        depth = (seen[..., 2] - self.view.eye.norm())[:, :, None].expand_as(much)
        return pixel, torch.where(inside, much, 0.0), depth
