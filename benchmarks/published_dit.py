"""A plain implementation of the published ACWM-DiT (arXiv 2605.08567) with AdaLN, as a baseline.

Parameters have the published names, so published weights load unchanged, and
`tests/dit/test_compared_with.py` compares its outputs with the published network's. It is written
like most such code: attention permutes tokens to sequences and back, rotary embedding rotates
neighbouring channels, and the modulation of a frame is expanded to its tokens.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

FREQUENCIES = 256
EPSILON = 1e-6


def sinusoids(timesteps: Tensor) -> Tensor:
    """Sinusoidal embedding of timesteps `[B, T]`: `[B, T, FREQUENCIES]`."""
    half = FREQUENCIES // 2
    steps = torch.arange(half, device=timesteps.device, dtype=torch.float32)
    angles = timesteps[..., None].float() * torch.exp(-math.log(10_000) * steps / half)
    return torch.cat([angles.cos(), angles.sin()], -1)


def rotary_tables(shape: tuple[int, ...], size: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Cosines and sines `[positions, size]` of a grid; each axis rotates its share of channels."""
    share = size // len(shape)
    exponents = torch.arange(0, share, 2, device=like.device, dtype=torch.float32) / share
    axes = [torch.arange(length, device=like.device, dtype=torch.float32) for length in shape]
    angles = [
        position.flatten()[:, None] * 10_000.0**-exponents
        for position in torch.meshgrid(*axes, indexing="ij")
    ]
    table = torch.cat(angles, -1).repeat_interleave(2, -1)
    return table.cos().to(like.dtype), table.sin().to(like.dtype)


def rotate(heads: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate each pair of neighbouring channels."""
    even, odd = heads.unflatten(-1, (-1, 2)).unbind(-1)
    return heads * cosine + torch.stack([-odd, even], -1).flatten(-2) * sine


class Attention(nn.Module):
    """Self-attention of sequences `[S, length, D]` on a grid of positions."""

    def __init__(self, width: int, heads: int, causal: bool) -> None:
        super().__init__()
        self.heads, self.causal = heads, causal
        self.qkv_proj = nn.Linear(width, 3 * width, bias=False)
        self.out_proj = nn.Linear(width, width)
        self._tables: dict[tuple[object, ...], tuple[Tensor, Tensor]] = {}

    def forward(self, sequences: Tensor, grid: tuple[int, ...]) -> Tensor:
        """Attend within sequences `[S, length, D]` whose positions form `grid`."""
        query, key, value = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in self.qkv_proj(sequences).chunk(3, -1)
        )
        kind = (grid, query.dtype, query.device)
        if kind not in self._tables:
            self._tables[kind] = rotary_tables(grid, query.shape[-1], query)
        cosine, sine = self._tables[kind]
        attended = functional.scaled_dot_product_attention(
            rotate(query, cosine, sine), rotate(key, cosine, sine), value, is_causal=self.causal
        )
        return self.out_proj(attended.transpose(1, 2).flatten(2))


class SubBlock(nn.Module):
    """Attention over space or over time, then an MLP, with AdaLN-Zero."""

    def __init__(self, width: int, heads: int, *, temporal: bool, causal: bool = False) -> None:
        super().__init__()
        self.temporal = temporal
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))
        self.norm1 = nn.LayerNorm(width, elementwise_affine=False, eps=EPSILON)
        self.norm2 = nn.LayerNorm(width, elementwise_affine=False, eps=EPSILON)
        self.attn = Attention(width, heads, causal)
        self.ffwd = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width)
        )

    def forward(self, tokens: Tensor, condition: Tensor) -> Tensor:
        """Tokens `[B, T, H, W, D]` under a condition `[B, T, D]`."""
        _, _, rows, columns, _ = tokens.shape
        modulation = self.adaLN_modulation(condition)[:, :, None, None]
        parts = modulation.expand(-1, -1, rows, columns, -1).chunk(6, -1)
        shift, scale, gate = parts[:3]
        tokens = tokens + self._attend(self.norm1(tokens) * (1 + scale) + shift) * gate
        shift, scale, gate = parts[3:]
        return tokens + self.ffwd(self.norm2(tokens) * (1 + scale) + shift) * gate

    def _attend(self, tokens: Tensor) -> Tensor:
        clips, frames, rows, columns, width = tokens.shape
        if not self.temporal:
            attended = self.attn(tokens.reshape(-1, rows * columns, width), (rows, columns))
            return attended.reshape(tokens.shape)
        over_time = tokens.permute(0, 2, 3, 1, 4).reshape(-1, frames, width)
        attended = self.attn(over_time, (frames,)).reshape(clips, rows, columns, frames, width)
        return attended.permute(0, 3, 1, 2, 4)


class Block(nn.Module):
    """A spatial sub-block, then a temporal one."""

    def __init__(self, width: int, heads: int, causal: bool) -> None:
        super().__init__()
        self.s_block = SubBlock(width, heads, temporal=False)
        self.t_block = SubBlock(width, heads, temporal=True, causal=causal)

    def forward(self, tokens: Tensor, condition: Tensor) -> Tensor:
        """Tokens `[B, T, H, W, D]` under a condition `[B, T, D]`."""
        return self.t_block(self.s_block(tokens, condition), condition)


class FinalLayer(nn.Module):
    """A modulated norm and a projection of each token to its patch."""

    def __init__(self, width: int, patch_values: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False, eps=EPSILON)
        self.linear = nn.Linear(width, patch_values)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))

    def forward(self, tokens: Tensor, condition: Tensor) -> Tensor:
        """Tokens `[B, T, H, W, D]` to the values of their patches."""
        shift, scale = self.adaLN_modulation(condition)[:, :, None, None].chunk(2, -1)
        return self.linear(self.norm(tokens) * (1 + scale) + shift)


class ActionEmbedder(nn.Module):
    """An MLP per action, then two convolutions of stride 2 over time."""

    def __init__(self, action_size: int, width: int) -> None:
        super().__init__()
        self.mlp_in = nn.Sequential(
            nn.Linear(action_size, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.downsample = nn.Sequential(
            nn.Conv1d(width, width, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv1d(width, width, 3, stride=2, padding=1),
        )
        self.mlp_out = nn.Sequential(nn.SiLU(), nn.Linear(width, width))

    def forward(self, actions: Tensor) -> Tensor:
        """Actions `[B, 1 + 4(T − 1), A]` to `[B, T, D]`."""
        features = self.downsample(self.mlp_in(actions).transpose(1, 2))
        return self.mlp_out(features.transpose(1, 2))


class PublishedDiT(nn.Module):
    """The network. It starts with PyTorch's initial weights, without the original's zeros."""

    def __init__(
        self,
        *,
        in_channels: int,
        action_size: int,
        width: int,
        layers: int,
        heads: int,
        patch_size: int = 2,
        causal: bool = False,
    ) -> None:
        super().__init__()
        self.in_channels, self.patch_size = in_channels, patch_size
        self.x_proj = nn.Conv2d(in_channels, width, patch_size, stride=patch_size)
        self.timestep_mlp = nn.Sequential(
            nn.Linear(FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.action_embedder = ActionEmbedder(action_size, width)
        self.blocks = nn.ModuleList(Block(width, heads, causal) for _ in range(layers))
        self.final_layer = FinalLayer(width, patch_size**2 * in_channels)

    def forward(self, latents: Tensor, timesteps: Tensor, actions: Tensor) -> Tensor:
        """Latents `[B, T, H, W, C]`, timesteps `[B, T]` in 0 … 1000, actions `[B, T', A]`."""
        clips, frames, height, width, channels = latents.shape
        patches = self.x_proj(latents.flatten(0, 1).permute(0, 3, 1, 2))
        tokens = patches.permute(0, 2, 3, 1).unflatten(0, (clips, frames))
        condition = self.timestep_mlp(sinusoids(timesteps)) + self.action_embedder(actions)
        for block in self.blocks:
            tokens = block(tokens, condition)
        values = self.final_layer(tokens, condition)
        grid = values.unflatten(-1, (self.patch_size, self.patch_size, channels))
        return grid.permute(0, 1, 2, 4, 3, 5, 6).reshape(clips, frames, height, width, channels)
