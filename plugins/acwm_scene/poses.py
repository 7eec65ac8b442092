"""What the model knows of agents and bodies: their poses on the plane."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


class Poses(NamedTuple):
    """Agents and bodies in one video frame, or with an axis T after B in several.

    Lengths are in units of the model.

    Attributes:
        agents: places, `[B, A, 2]`.
        present: 1 for a body that is there and 0 for one that is not, `[B, N, 1]`.
        places: of the bodies, `[B, N, 2]`.
        turns: cosine and sine of the body's angle times its folds, `[B, N, 2]`.
    """

    agents: Tensor
    present: Tensor
    places: Tensor
    turns: Tensor


def turned(vector: Tensor, by: Tensor) -> Tensor:
    """A vector `[…, 2]` turned by the angle whose cosine and sine are `by`, `[…, 2]`."""
    x, y = vector.unbind(-1)
    cos, sin = by.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def turned_back(vector: Tensor, by: Tensor) -> Tensor:
    """The inverse of `turned`: the vector as it is seen in a frame that is turned `by`."""
    return turned(vector, by * by.new_tensor([1.0, -1.0]))


def waves(values: Tensor, octaves: int) -> Tensor:
    """The values `[…, D]` and their Fourier features, `[…, D (1 + 2 octaves)]`.

    The longest wave has 8 units, and each further one half the length.
    """
    lengths = (math.pi / 4) * 2.0 ** torch.arange(octaves, device=values.device)
    angles = (values[..., None] * lengths).flatten(-2)
    return torch.cat([values, angles.sin(), angles.cos()], -1)


def waves_size(size: int, octaves: int) -> int:
    """Number of features that `waves` makes of `size` values."""
    return size * (1 + 2 * octaves)
