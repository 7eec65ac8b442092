"""The networks that `training.py` compares, all called as `network(latents, sigma, actions)`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from published_dit import PublishedDiT
from torch import Tensor, nn

from acwm_core.plugins import catalog
from acwm_dit.plugin import SIZES as DIT_SIZES

CHANNELS, ACTION_SIZE, STRIDE, PATCH = 16, 2, 4, 2

Inputs = tuple[Tensor, Tensor, Tensor]
"""Latents `[B, L, C, h, w]`, noise levels `[B, L]`, actions `[B, T, A]`."""


@dataclass(frozen=True)
class Size:
    """Width, depth and tokens: `clips` × `frames` × `side`²."""

    width: int
    layers: int
    heads: int
    clips: int
    frames: int
    side: int

    @property
    def tokens(self) -> int:
        """Number of tokens in a batch."""
        return self.clips * self.frames * self.side**2

    def inputs(self, device: torch.device) -> Inputs:
        """Random inputs; the first frame is clean, as in training."""
        generator = torch.Generator().manual_seed(0)
        shape = (self.clips, self.frames, CHANNELS, PATCH * self.side, PATCH * self.side)
        latents = torch.randn(shape, generator=generator)
        sigma = torch.rand(self.clips, 1, generator=generator).repeat(1, self.frames)
        sigma[:, 0] = 0
        rows = 1 + STRIDE * (self.frames - 1)
        actions = torch.rand(self.clips, rows, ACTION_SIZE, generator=generator) * 2 - 1
        return latents.to(device), sigma.to(device), actions.to(device)


SIZES = {
    "small": Size(width=128, layers=3, heads=2, clips=16, frames=10, side=4),
    "192x4": Size(width=192, layers=4, heads=3, clips=1, frames=10, side=8),
    "384x6": Size(width=384, layers=6, heads=6, clips=1, frames=10, side=8),
    "768x2": Size(width=768, layers=2, heads=12, clips=1, frames=10, side=15),
}
"""Sizes that a CPU trains; `small` is the network of the small recipes."""

PUBLISHED = {
    name: Size(width, layers, heads, clips=4, frames=10, side=15)
    for name, (width, layers, heads, _) in DIT_SIZES.items()
    if name != "dit_xs"
}
"""The published networks and setting: 37 frames of 240×240."""


class Ours(nn.Module):
    """acwm's DiT with its AdaLN conditioner, as recipes build them."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        fit = {"width": size.width, "layers": size.layers, "heads": size.heads}
        self.model = catalog().create(
            "model", "dit_xs", latent_channels=CHANNELS, patch_size=PATCH, **fit
        )
        self.conditioner = catalog().create(
            "conditioner", "adaln", action_size=ACTION_SIZE, temporal_stride=STRIDE, **fit
        )

    def forward(self, latents: Tensor, sigma: Tensor, actions: Tensor) -> Tensor:
        """The prediction `[B, L, C, h, w]`."""
        return self.model(latents, sigma, self.conditioner(actions))


class Published(nn.Module):
    """The published network, which keeps channels last."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        self.model = PublishedDiT(
            in_channels=CHANNELS,
            action_size=ACTION_SIZE,
            width=size.width,
            layers=size.layers,
            heads=size.heads,
            patch_size=PATCH,
        )

    def forward(self, latents: Tensor, sigma: Tensor, actions: Tensor) -> Tensor:
        """The prediction `[B, L, C, h, w]`."""
        out = self.model(latents.permute(0, 1, 3, 4, 2), 1000 * sigma, actions)
        return out.permute(0, 1, 4, 2, 3)


class Latte(nn.Module):
    """diffusers' Latte (Ma et al. 2024, arXiv 2401.03048) without its captions.

    The closest model in a common library: alternating spatial and temporal blocks. It does less:
    one noise level per clip, no actions, added position embeddings, and one modulation for all
    layers.
    """

    def __init__(self, size: Size) -> None:
        from diffusers import LatteTransformer3DModel

        super().__init__()
        self.model = LatteTransformer3DModel(
            num_attention_heads=size.heads,
            attention_head_dim=size.width // size.heads,
            in_channels=CHANNELS,
            num_layers=size.layers,
            sample_size=PATCH * size.side,
            patch_size=PATCH,
            activation_fn="gelu-approximate",
            norm_type="ada_norm_single",
            norm_elementwise_affine=False,
            norm_eps=1e-6,
            caption_channels=1,
            video_length=size.frames,
        )

    def forward(self, latents: Tensor, sigma: Tensor, actions: Tensor) -> Tensor:
        """The prediction `[B, L, C, h, w]`."""
        captions = latents.new_zeros(len(latents), 1, 1)
        (out,) = self.model(
            latents.transpose(1, 2), 1000 * sigma[:, -1], captions, return_dict=False
        )
        return out.transpose(1, 2)


NETWORKS: dict[str, type[nn.Module]] = {
    "acwm": Ours,
    "published, plain": Published,
    "diffusers' Latte": Latte,
}


def build(name: str, size: Size, device: torch.device) -> nn.Module:
    """A network with random weights everywhere, so that no gradient is zero."""
    torch.manual_seed(0)
    network = NETWORKS[name](size)
    for parameter in network.parameters():
        if not parameter.any():
            nn.init.normal_(parameter, std=0.02)
    return network.to(device).train()
