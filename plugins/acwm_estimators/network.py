"""The network: computes masks and maps from one frame, and reads values from the maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from acwm_estimators.layout import Layout, Surface

HEIGHT = 128
"""Height in pixels to which every frame is resized; the maps are half as high."""

WIDTHS = (16, 32, 56)
"""Channels at 1/2, 1/4 and 1/8 of the frame's resolution."""

HEAD = 24
"""Channels from which the maps are computed."""

HIDDEN = 32
"""Width of the layer that reads numbers, such as orientation, from all pixels of a body."""

EDGES = 4
"""Number of channels of `edges`."""

AT_ONCE = 2
"""Frames whose edges are computed at once: as many as fit into a core's cache, which is 1.7 times
as fast as eight."""

BLUR = 1.0
"""Width of a heat map's target, in cells."""


def convolution(inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A 3×3 convolution, batch normalisation and ReLU."""
    layer = nn.Conv2d(inputs, outputs, 3, stride, padding=dilation, dilation=dilation, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Features(nn.Module):
    """A small U-Net: maps `[N, 3, H, W]` to `[N, HEAD, H / 2, W / 2]`; H and W multiples of 8."""

    def __init__(self) -> None:
        super().__init__()
        fine, middle, coarse = WIDTHS
        self.fine = nn.Sequential(convolution(3, fine, 2), convolution(fine, fine))
        self.middle = nn.Sequential(convolution(fine, middle, 2), convolution(middle, middle))
        self.down = convolution(middle, coarse, 2)
        self.coarse = nn.ModuleList(convolution(coarse, coarse, 1, d) for d in (1, 2, 4))
        self.to_middle = nn.Conv2d(coarse, middle, 1)
        self.up_middle = convolution(middle, middle)
        self.to_fine = nn.Conv2d(middle, fine, 1)
        self.up_fine = convolution(fine, HEAD)

    def fuse(self) -> None:
        """Merge the normalisation of a trained network into its convolutions (inference only)."""
        for module in self.modules():
            if not isinstance(module, nn.Sequential):
                continue
            layer, norm = module[0], module[1]
            if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[0], module[1] = fuse_conv_bn_eval(layer, norm), nn.Identity()

    def forward(self, frames: Tensor) -> Tensor:
        fine = self.fine(frames)
        middle = self.middle(fine)
        coarse = self.down(middle)
        for layer in self.coarse:
            coarse = coarse + layer(coarse)
        middle = self.up_middle(_twice(self.to_middle(coarse)).add_(middle))
        return self.up_fine(_twice(self.to_fine(middle)).add_(fine))


@dataclass(frozen=True)
class NetworkOutput:
    """The output of the network for N frames.

    Attributes:
        quarters: logits of the background and the layout's instances, `[N, 4 (1 + I), h, w]`, with
            four pixels per cell of the maps.
        heat: logarithms of heat maps by field, `[N, rows, h, w]`.
        points: positions by field, `[N, rows, 3]`: x to the right and y down from the frame's
            centre, in frame heights, and depth in metres (0 on planes).
        locals: encoded numbers, `[N, count, width]`, in the order of the layout.
        totals: amounts, `[N, K]`.
        surface: heights in metres, `[N, rows, columns]`, or None.
    """

    quarters: Tensor
    heat: Mapping[str, Tensor]
    points: Mapping[str, Tensor]
    locals: tuple[Tensor, ...]
    totals: Tensor
    surface: Tensor | None

    @property
    def logits(self) -> Tensor:
        """Logits of the background and the layout's instances, `[N, 1 + I, HEIGHT, W]`."""
        return functional.pixel_shuffle(self.quarters, 2)

    def logits_at(self, size: tuple[int, int]) -> Tensor:
        """The logits at a frame's size, `[N, 1 + I, *size]` float32."""
        if tuple(self.quarters.shape[2:]) == size:  # interpolation is then the mean of four pixels
            return 0.25 * self.quarters.float().unflatten(1, (-1, 4)).sum(2)
        return functional.interpolate(self.logits.float(), size, mode="bilinear")


class StateNetwork(nn.Module):
    """The network for one layout.

    Every value is read where it is seen: a position from a heat map and corrections at its peak, an
    angle at the heat map of its body, an amount as a sum over the frame. So the values depend
    little on what scenes usually look like, which makes them measurements.

    Args:
        layout: layout of the environment.
    """

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.layout = layout
        self.features = Features()
        self.instances = nn.Conv2d(HEAD, 4 * (1 + len(layout.instances)), 1)
        self.maps = nn.Conv2d(HEAD, sum(self.channels), 1)
        self.bodies = nn.ModuleDict(
            {
                str(index): nn.Sequential(
                    nn.Linear(HEAD + EDGES + 2, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, local.width)
                )
                for index, local in enumerate(layout.locals)
                if local.whole
            }
        )
        for points in layout.points:
            self.register_buffer(f"depth_{points.field}", torch.tensor([1.0, 1.0]))
        for index, local in enumerate(layout.locals):
            self.register_buffer(f"local_{index}", torch.ones(2, local.width))
        self.register_buffer("total_scale", torch.ones(len(layout.totals)))

    @property
    def channels(self) -> list[int]:
        """Channels of the maps: heat and corrections for each field of points, then all others."""
        points = [points.rows + 3 for points in self.layout.points]
        numbers = [0 if local.whole else local.width for local in self.layout.locals]
        return [*points, *numbers, len(self.layout.totals), int(self.layout.surface is not None)]

    def calibrate(self, targets: Mapping[str, np.ndarray]) -> None:
        """Set mean and spread of the regressed values from training targets."""
        for points in self.layout.points:
            there = targets[f"there:{points.field}"] > 0
            depth = targets[f"points:{points.field}"][..., 2][there]
            spread = max(float(depth.std()), 0.01)
            getattr(self, f"depth_{points.field}").copy_(
                torch.tensor([float(depth.mean()), spread])
            )
        for index in range(len(self.layout.locals)):
            codes = targets[f"local:{index}"].reshape(-1, targets[f"local:{index}"].shape[-1])
            spread = np.maximum(codes.std(0), 0.1 * np.abs(codes).max(0) + 1e-6)
            getattr(self, f"local_{index}").copy_(
                torch.as_tensor(np.stack([codes.mean(0), spread]))
            )
        if self.layout.totals:
            self.get_buffer("total_scale").copy_(torch.as_tensor(targets["totals"].mean(0)))

    def forward(self, frames: Tensor) -> NetworkOutput:
        """Read frames `[N, 3, H, W]` in [0, 1] of any size."""
        height, width = frames.shape[-2:]
        aspect = width / height
        size = (HEIGHT, 8 * round(HEIGHT * aspect / 8))
        frames = frames * 2 - 1
        if (height, width) != size:
            frames = functional.interpolate(
                frames, size, mode="bilinear", antialias=height > HEIGHT
            )
        frames = frames.contiguous()
        features = self.features(frames.contiguous(memory_format=torch.channels_last))
        quarters = pointwise(self.instances, features)
        maps = list(pointwise(self.maps, features).float().split(self.channels, dim=1))
        surface, totals = maps.pop(), maps.pop()
        heat, points = self._points(maps, aspect)
        bodies = self._bodies(frames, features, quarters, points) if self.bodies else {}
        codes = self._numbers(maps[len(self.layout.points) :], heat, bodies)
        amounts = functional.softplus(totals).mean((2, 3)) * self.get_buffer("total_scale") * 8
        heights = self._heights(surface, self.layout.surface, aspect)
        return NetworkOutput(quarters, heat, points, codes, amounts, heights)

    def _points(
        self, maps: list[Tensor], aspect: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        heat: dict[str, Tensor] = {}
        found: dict[str, Tensor] = {}
        for points, channels in zip(self.layout.points, maps, strict=False):
            warm, corrections = channels.split([points.rows, 3], dim=1)
            heat[points.field] = warm.flatten(2).log_softmax(-1).unflatten(-1, warm.shape[2:])
            weights = heat[points.field].exp()
            cell = 1 / warm.shape[2]
            places = cells(warm.shape[2], warm.shape[3], aspect).to(warm)
            there = under(weights, places[None] + corrections[:, :2] * cell)
            mean, spread = getattr(self, f"depth_{points.field}")
            depth = under(weights, corrections[:, 2:]) * spread + mean
            found[points.field] = torch.cat([there, depth], dim=-1)
        return heat, found

    def _bodies(
        self, frames: Tensor, features: Tensor, quarters: Tensor, found: Mapping[str, Tensor]
    ) -> dict[int, Tensor]:
        """Codes of the numbers that are read from whole bodies, by their index in the layout."""
        inside = quarters.detach().float().unflatten(1, (-1, 4)).softmax(1).mean(2)
        few = frames.split(AT_ONCE)
        features, directions = features.float(), torch.cat([edges(each) for each in few])
        codes: dict[int, Tensor] = {}
        for key, reads in self.bodies.items():
            local = self.layout.locals[int(key)]
            (points,) = [each for each in self.layout.points if each.field == local.under]
            names = points.instances[: local.count]
            weights = inside[:, [1 + self.layout.instances.index(name) for name in names]]
            weights = weights / weights.sum((2, 3), keepdim=True).clamp(min=1e-3)
            place = found[local.under][:, : local.count, :2].detach()
            body = [under(weights, features), under(weights, directions), place]
            codes[int(key)] = reads(torch.cat(body, dim=-1))
        return codes

    def _numbers(
        self, maps: list[Tensor], heat: Mapping[str, Tensor], bodies: Mapping[int, Tensor]
    ) -> tuple[Tensor, ...]:
        codes: list[Tensor] = []
        for index, local in enumerate(self.layout.locals):
            if local.whole:
                code = bodies[index]
            else:
                code = under(heat[local.under][:, : local.count].exp(), maps[index])
            mean, spread = getattr(self, f"local_{index}")
            codes.append(code * spread + mean)
        return tuple(codes)

    def _heights(self, values: Tensor, surface: Surface | None, aspect: float) -> Tensor | None:
        if surface is None:
            return None
        (rows, columns), (deep, wide) = surface.cells, surface.extent
        y = (np.arange(rows) + 0.5) / rows * 2 * deep - deep
        x = (np.arange(columns) + 0.5) / columns * 2 * wide - wide
        ground = np.stack(np.broadcast_arrays(x[None], y[:, None], surface.height), axis=-1)
        seen = self.layout.camera.to_frame(ground)[..., :2] * [2 / aspect, 2]
        grid = torch.as_tensor(seen).to(values).expand(len(values), -1, -1, -1)
        return 0.1 * functional.grid_sample(values, grid, align_corners=False)[:, 0]


def cells(height: int, width: int, aspect: float) -> Tensor:
    """Centres of a map's cells in frame coordinates, `[2, height, width]`: x and y."""
    x = ((torch.arange(width) + 0.5) / width - 0.5) * aspect
    y = (torch.arange(height) + 0.5) / height - 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def pointwise(layer: nn.Conv2d, features: Tensor) -> Tensor:
    """Apply a 1×1 convolution to features in any memory layout; each map becomes contiguous.

    Only sums over maps follow, and these are several times faster in this layout.
    """
    flat, bias = features.flatten(2), layer.bias
    assert bias is not None
    weight = layer.weight.flatten(1).expand(len(flat), -1, -1)
    return torch.bmm(weight, flat).add_(bias[:, None]).unflatten(2, features.shape[2:])


def under(weights: Tensor, maps: Tensor) -> Tensor:
    """Weighted means of maps `[N, C, h, w]` with weights `[N, rows, h, w]`: `[N, rows, C]`."""
    return weights.flatten(2) @ maps.flatten(2).transpose(1, 2)


def edges(frames: Tensor) -> Tensor:
    """Directions of edges modulo half turns and modulo quarter turns, `[N, 4, H / 2, W / 2]`.

    Gradients are complex numbers, raised to the second and fourth power while keeping their length.
    So opposite sides of a body, and all four sides of a square, add up (Bigün and Granlund 1987).

    Args:
        frames: frames `[N, 3, H, W]` in [-1, 1].
    """
    x = frames[:, :, 1:-1, 2:] - frames[:, :, 1:-1, :-2]
    y = frames[:, :, 2:, 1:-1] - frames[:, :, :-2, 1:-1]
    x2 = x * x
    scale = x2.addcmul(y, y).add_(4e-8).rsqrt_()
    real = x2.addcmul_(y, y, value=-1).mul_(scale)
    half = x.mul_(y).mul_(scale)  # half of the imaginary part
    real4 = (real * real).addcmul_(half, half, value=-4).mul_(scale)
    quarter = (real * half).mul_(scale)
    powers = frames.new_zeros(len(frames), 4, *frames.shape[2:])
    for place, (part, parts) in enumerate([(real, 1), (half, 2), (real4, 1), (quarter, 4)]):
        torch.sum(part, 1, out=powers[:, place, 1:-1, 1:-1]).mul_(parts)
    rows = powers.unflatten(2, (-1, 2)).sum(3)
    return rows[..., ::2] + rows[..., 1::2]


def _twice(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="bilinear")
