"""The parts of a DiT layer: spatial and temporal sub-blocks, modulated per latent frame."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from acwm_core.model.shapes import Modulation, Tokens
from acwm_dit.attention import Rotation, attend
from acwm_dit.cache import LayerCache
from acwm_dit.linear import Linear, linear_gelu

EPSILON = 1e-6
"""Epsilon of the layer norms. They have no weights of their own: AdaLN gives scale and shift."""

MLP_RATIO = 4


class SubBlock(nn.Module):
    """Attention along one axis, then an MLP, each with AdaLN-Zero modulation and a residual.

    Peebles & Xie 2023, arXiv 2212.09748. The six modulation vectors are computed once per latent
    frame and broadcast over its tokens.

    Args:
        width: token width D.
        heads: attention heads; must divide the width.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.modulation = Linear(width, 6 * width)
        self.qkv = Linear(width, 3 * width, bias=False)
        self.out = Linear(width, width)
        self.mlp = Mlp(width)

    def forward(
        self,
        tokens: Tokens,
        modulation: Tensor,
        rotation: Rotation,
        past: LayerCache | None = None,
    ) -> Tokens:
        """Apply the sub-block to tokens.

        Args:
            tokens: `[B, L, N, D]`.
            modulation: `[B, L, 6·D]`, the output of `self.modulation` for the condition.
            rotation: rotary embedding of the positions along the attention's axis.
            past: keys and values of earlier frames, for temporal attention.
        """
        parts = modulation.unsqueeze(2).chunk(6, -1)
        shift, scale, gate = parts[:3]
        attended = self.out(self._attention(modulate(tokens, shift, scale), rotation, past))
        tokens = torch.addcmul(tokens, gate, attended)
        shift, scale, gate = parts[3:]
        return torch.addcmul(tokens, gate, self.mlp(modulate(tokens, shift, scale)))

    def _attention(self, tokens: Tokens, rotation: Rotation, past: LayerCache | None) -> Tokens:
        raise NotImplementedError

    def _project(self, tokens: Tokens, rotation: Rotation) -> tuple[Tensor, Tensor, Tensor]:
        """Rotated queries, rotated keys, and values, each `[B, L, N, heads, size]`."""
        qkv = self.qkv(tokens).unflatten(-1, (3, self.heads, -1))
        query_key, value = qkv.split([2, 1], -3)
        query, key = rotation.to(qkv.dtype)(query_key).unbind(-3)
        return query, key, value.squeeze(-3)


class Mlp(nn.Sequential):
    """Two linear layers with a GELU between them, on tokens `[…, D]`."""

    def __init__(self, width: int) -> None:
        wide = MLP_RATIO * width
        super().__init__(Linear(width, wide), nn.GELU(approximate="tanh"), Linear(wide, width))

    def forward(self, input: Tensor) -> Tensor:
        """Apply the three modules in order, with the first two fused."""
        first, _, last = self
        return last(linear_gelu(cast(Linear, first), input))


class SpatialBlock(SubBlock):
    """A sub-block whose attention runs over the patches of each frame."""

    def _attention(self, tokens: Tokens, rotation: Rotation, past: LayerCache | None) -> Tokens:
        # Broadcasts tables [N, size] to [B, L, N, 2, heads, size].
        projected = self._project(tokens, rotation.unsqueeze(1, 1))
        query, key, value = (part.flatten(0, 1).transpose(1, 2) for part in projected)
        return attend(query, key, value).transpose(1, 2).reshape(tokens.shape)


class TemporalBlock(SubBlock):
    """A sub-block whose attention runs over the frames at each patch position.

    The patches of a frame are treated as additional heads, so that no token moves in memory.

    Args:
        width: token width D.
        heads: attention heads.
        causal: whether a frame sees only itself and earlier ones.
    """

    def __init__(self, width: int, heads: int, *, causal: bool) -> None:
        super().__init__(width, heads)
        self.causal = causal

    def _attention(self, tokens: Tokens, rotation: Rotation, past: LayerCache | None) -> Tokens:
        # Broadcasts tables [L, size] to [B, L, N, 2, heads, size].
        projected = self._project(tokens, rotation.unsqueeze(1, 1, 1))
        query, key, value = (part.flatten(2, 3).transpose(1, 2) for part in projected)
        if past is None:
            attended = attend(query, key, value, causal=self.causal)
        else:
            attended = past.attend(query, key, value)
        return attended.transpose(1, 2).reshape(tokens.shape)


class Layer(nn.Module):
    """One layer of the DiT: a spatial, then a temporal sub-block."""

    def __init__(self, width: int, heads: int, *, causal: bool) -> None:
        super().__init__()
        self.spatial = SpatialBlock(width, heads)
        self.temporal = TemporalBlock(width, heads, causal=causal)

    def forward(
        self,
        tokens: Tokens,
        condition: Modulation,
        space: Rotation,
        time: Rotation,
        past: LayerCache | None = None,
    ) -> Tokens:
        """Apply both to tokens `[B, L, N, D]`; `condition` `[B, L, D]` is already through SiLU."""
        tokens = self.spatial(tokens, self.spatial.modulation(condition), space)
        return self.temporal(tokens, self.temporal.modulation(condition), time, past)


class FinalLayer(nn.Module):
    """A modulated norm and a projection of each token to its patch of latents."""

    def __init__(self, width: int, patch_values: int) -> None:
        super().__init__()
        self.modulation = Linear(width, 2 * width)
        self.linear = Linear(width, patch_values)

    def forward(self, tokens: Tokens, condition: Modulation) -> Tensor:
        """Map tokens `[B, L, N, D]` to `[B, L, N, patch_values]`."""
        shift, scale = self.modulation(condition).unsqueeze(2).chunk(2, -1)
        return self.linear(modulate(tokens, shift, scale))


def modulate(tokens: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """Layer norm of the tokens, then scale by 1 + `scale` and shift."""
    normed = functional.layer_norm(tokens, tokens.shape[-1:], eps=EPSILON)
    return torch.addcmul(shift, normed, 1 + scale)
