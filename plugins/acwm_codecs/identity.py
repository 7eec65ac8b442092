"""`Identity`: pixels folded into channels as latents; nothing is learned, and nothing is lost."""

from __future__ import annotations

import hashlib

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.codec import Codec
from acwm_core.model.shapes import Latent, Video

CENTRE, SPREAD = 0.5, 0.25
"""Pixels become (value − CENTRE) / SPREAD, which is about zero mean and unit variance usually."""


class Identity(Codec):
    """Folds each block of pixels and frames into the channels of one latent pixel.

    Video frame 0 is repeated to fill the group of the first latent frame. A round trip returns the
    video up to float32 rounding, and 8-bit video exactly. Due to the folding, the number of tokens,
    and so the cost of a model, is the same as with other codecs. With both strides at 1, pixels are
    not folded, and the cost is far higher.

    Args:
        spatial_stride: side of a block in pixels.
        temporal_stride: frames per group.

    Raises:
        RecipeError: a stride is below 1.
    """

    memoryless = True

    def __init__(self, *, spatial_stride: int = 8, temporal_stride: int = 4) -> None:
        super().__init__()
        if spatial_stride < 1 or temporal_stride < 1:
            raise RecipeError(
                f"codec identity needs strides of at least 1, not spatial_stride={spatial_stride} "
                f"and temporal_stride={temporal_stride}"
            )
        self.spatial_stride = spatial_stride
        self.temporal_stride = temporal_stride
        self.channels = 3 * temporal_stride * spatial_stride**2

    def _encode(self, video: Video) -> Latent:
        first = video[:, :1].expand(-1, self.temporal_stride, -1, -1, -1)
        frames = torch.cat([first, video[:, 1:]], dim=1)
        groups = frames.unflatten(1, (-1, self.temporal_stride)).flatten(2, 3)
        return (functional.pixel_unshuffle(groups, self.spatial_stride) - CENTRE) / SPREAD

    def _decode(self, latents: Latent) -> Video:
        frames = self._decode_later(latents)
        first, rest = frames[:, : self.temporal_stride], frames[:, self.temporal_stride :]
        return torch.cat([first.mean(1, keepdim=True), rest], dim=1)

    def _decode_later(self, latents: Latent) -> Video:
        groups: Tensor = functional.pixel_shuffle(latents, self.spatial_stride) * SPREAD + CENTRE
        return groups.unflatten(2, (self.temporal_stride, 3)).flatten(1, 2)

    def fingerprint(self) -> str:
        configuration = f"identity {self.spatial_stride} {self.temporal_stride}"
        return hashlib.sha256(configuration.encode()).hexdigest()[:12]
