"""Scaled dot-product attention and rotary position embeddings (RoPE)."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

THETA = 10_000.0
"""Base of the rotary frequencies."""


def attend(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    *,
    causal: bool = False,
    mask: Tensor | None = None,
) -> Tensor:
    """Attention of `[batch, heads, length, size]`.

    On a CPU, the bfloat16 kernel of `scaled_dot_product_attention` is many times slower than plain
    matrix products at the short lengths of these models, especially in the backward pass. The
    float32 kernel is not.

    Args:
        query, key, value: the inputs; there may be fewer queries than keys.
        causal: whether to hide later positions.
        mask: `[queries, keys]`, true where a query sees a key; use either this or `causal`.
    """
    if query.device.type != "cpu" or query.dtype != torch.bfloat16:
        return functional.scaled_dot_product_attention(
            query, key, value, attn_mask=mask, is_causal=causal
        )
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    if causal:
        mask = torch.ones(scores.shape[-2:], dtype=torch.bool, device=scores.device).tril()
    if mask is not None:
        scores = scores.masked_fill(~mask, float("-inf"))
    return scores.softmax(-1, dtype=torch.float32).to(value.dtype) @ value


@dataclass(frozen=True)
class Rotation:
    """Rotary position embedding (RoPE, Su et al. 2021, arXiv 2104.09864) of a set of positions.

    Channel j of a head is paired with channel j + size/2, and each pair is rotated by its angle.

    Attributes:
        cosine: cosines of the angles, `[positions, size]`.
        sine: sines of the angles, `[positions, size]`, negated in the first half.
    """

    cosine: Tensor
    sine: Tensor

    @classmethod
    def from_angles(cls, angles: Tensor) -> Rotation:
        """Create a rotation from angles `[positions, size / 2]` in radians."""
        cosine, sine = angles.cos(), angles.sin()
        return cls(torch.cat([cosine, cosine], -1), torch.cat([-sine, sine], -1))

    def to(self, dtype: torch.dtype) -> Rotation:
        """Convert to another precision."""
        return Rotation(self.cosine.to(dtype), self.sine.to(dtype))

    def __call__(self, heads: Tensor) -> Tensor:
        """Rotate `heads`, whose last axis is `size`; the tables broadcast over the other axes."""
        turned = heads.roll(heads.shape[-1] // 2, -1)
        return torch.addcmul(heads * self.cosine, turned, self.sine)

    def unsqueeze(self, *axes: int) -> Rotation:
        """Add axes of size one, so that the tables broadcast over them."""
        cosine, sine = self.cosine, self.sine
        for axis in axes:
            cosine, sine = cosine.unsqueeze(axis), sine.unsqueeze(axis)
        return Rotation(cosine, sine)


@functools.lru_cache(maxsize=64)
def temporal_rotation(frames: int, size: int, device: torch.device, first: int = 0) -> Rotation:
    """Rotation of latent frames `first` … `first` + `frames` − 1 for heads of `size` channels."""
    return _table(_angles(frames, size, first), device)


@functools.lru_cache(maxsize=64)
def spatial_rotation(rows: int, columns: int, size: int, device: torch.device) -> Rotation:
    """Rotation of the patches of a frame in row-major order.

    The first half of the pairs encodes the row, the second half the column.
    """
    down = _angles(rows, size // 2)[:, None].expand(-1, columns, -1)
    along = _angles(columns, size // 2)[None].expand(rows, -1, -1)
    return _table(torch.cat([down, along], -1).flatten(0, 1), device)


def _angles(positions: int, size: int, first: int = 0) -> Tensor:
    """Angles `[positions, size / 2]`: position p rotates pair i by p · THETA^(−2i / size).

    Computed in float64 for long streams: float32 resolves angles near 10⁶ only to a tenth.
    """
    exponents = torch.arange(0, size, 2, dtype=torch.float64) / size
    place = torch.arange(first, first + positions, dtype=torch.float64)
    return place[:, None] * THETA**-exponents


def _table(angles: Tensor, device: torch.device) -> Rotation:
    """The rotation in float32. It is cached, so it must suit training even if inference made it."""
    with torch.inference_mode(False):
        rotation = Rotation.from_angles(angles)
        cosine, sine = rotation.cosine, rotation.sine
        return Rotation(cosine.to(device, torch.float32), sine.to(device, torch.float32))
