"""Scaled dot-product attention and rotary position embeddings (RoPE)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

THETA = 10_000.0
"""Base of the rotary frequencies."""


def attend(query: Tensor, key: Tensor, value: Tensor, *, causal: bool = False) -> Tensor:
    """Attention of `[batch, heads, length, size]`; `causal` hides later positions.

    On a CPU the bfloat16 kernel behind `scaled_dot_product_attention` is many times slower than
    plain products at the short lengths of these models, backward above all; float32 is not.
    """
    if query.device.type != "cpu" or query.dtype != torch.bfloat16:
        return functional.scaled_dot_product_attention(query, key, value, is_causal=causal)
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    if causal:
        later = torch.ones(scores.shape[-2:], dtype=torch.bool, device=scores.device).triu(1)
        scores = scores.masked_fill(later, float("-inf"))
    return scores.softmax(-1, dtype=torch.float32).to(value.dtype) @ value


@dataclass(frozen=True)
class Rotation:
    """Rotary position embedding (Su et al. 2021, arXiv 2104.09864) of a set of positions.

    Channel j of a head is paired with channel j + size/2, and the pair turned by its angle.

    Attributes:
        cosine: `[positions, size]`.
        sine: `[positions, size]`, negated in the first half.
    """

    cosine: Tensor
    sine: Tensor

    @classmethod
    def from_angles(cls, angles: Tensor) -> Rotation:
        """From angles `[positions, size / 2]` in radians."""
        cosine, sine = angles.cos(), angles.sin()
        return cls(torch.cat([cosine, cosine], -1), torch.cat([-sine, sine], -1))

    def to(self, dtype: torch.dtype) -> Rotation:
        """The same in another precision."""
        return Rotation(self.cosine.to(dtype), self.sine.to(dtype))

    def __call__(self, heads: Tensor) -> Tensor:
        """Turn `heads`, whose last axis is `size`; the tables broadcast over the other axes."""
        turned = heads.roll(heads.shape[-1] // 2, -1)
        return torch.addcmul(heads * self.cosine, turned, self.sine)

    def unsqueeze(self, *axes: int) -> Rotation:
        """Add axes of size one, so that the tables broadcast over them."""
        cosine, sine = self.cosine, self.sine
        for axis in axes:
            cosine, sine = cosine.unsqueeze(axis), sine.unsqueeze(axis)
        return Rotation(cosine, sine)


def temporal_rotation(frames: int, size: int, device: torch.device) -> Rotation:
    """Rotation of latent frames 0 … `frames` − 1 for heads of `size` channels."""
    return Rotation.from_angles(_angles(frames, size, device))


def spatial_rotation(rows: int, columns: int, size: int, device: torch.device) -> Rotation:
    """Rotation of the patches of a frame in row-major order.

    The first half of the pairs turns with the row, the second with the column.
    """
    down = _angles(rows, size // 2, device)[:, None].expand(-1, columns, -1)
    along = _angles(columns, size // 2, device)[None].expand(rows, -1, -1)
    return Rotation.from_angles(torch.cat([down, along], -1).flatten(0, 1))


def _angles(positions: int, size: int, device: torch.device) -> Tensor:
    """`[positions, size / 2]`: position p turns pair i by p · THETA^(−2i / size)."""
    exponents = torch.arange(0, size, 2, device=device, dtype=torch.float32) / size
    return torch.arange(positions, device=device)[:, None] * THETA**-exponents
