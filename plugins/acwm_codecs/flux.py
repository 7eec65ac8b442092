"""`Flux`: the image autoencoder of FLUX.1, frame by frame, with its published weights."""

from __future__ import annotations

import torch
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from torch import Tensor

from acwm_codecs.pretrained import fingerprint, load_autoencoder
from acwm_core.model.codec import Codec
from acwm_core.model.shapes import Latent, Video

HUB = "black-forest-labs/FLUX.1-dev"
"""The default repository; its folder `vae` is used. Users must accept its licence on the Hub."""

FRAMES_AT_ONCE = 4
"""Frames per pass through the network, so that long clips need no more memory than short ones."""


class Flux(Codec):
    """The image autoencoder of FLUX.1, applied frame by frame: strides 8×8, 16 channels.

    Latents are the mean of the posterior, minus `shift_factor`, times `scaling_factor`, both from
    the configuration (0.1159 and 0.3611 in the release).

    Args:
        weights: a hub repository or a folder in diffusers' layout, directly or in its folder
            `vae`.

    Raises:
        DataError: the weights do not exist, cannot be reached, or belong to another codec.
    """

    temporal_stride = 1
    memoryless = True

    def __init__(self, *, weights: str = HUB) -> None:
        super().__init__()
        loaded = load_autoencoder(AutoencoderKL, weights, "flux")
        self.autoencoder = loaded.requires_grad_(False)
        configuration = loaded.config
        self.channels = configuration["latent_channels"]
        self.spatial_stride = 2 ** (len(configuration["block_out_channels"]) - 1)
        self.shift: float = configuration["shift_factor"] or 0.0
        self.scale: float = configuration["scaling_factor"]
        self.eval()

    def _encode(self, video: Video) -> Latent:
        chunks = video.flatten(0, 1).split(FRAMES_AT_ONCE)
        return torch.cat([self._encode_frames(chunk) for chunk in chunks]).unflatten(
            0, video.shape[:2]
        )

    def _decode(self, latents: Latent) -> Video:
        chunks = latents.flatten(0, 1).split(FRAMES_AT_ONCE)
        return torch.cat([self._decode_frames(chunk) for chunk in chunks]).unflatten(
            0, latents.shape[:2]
        )

    def _encode_frames(self, frames: Tensor) -> Tensor:
        pixels = (frames * 2 - 1).to(self.autoencoder.dtype)
        posterior = self.autoencoder.encode(pixels).latent_dist  # pyright: ignore
        return (posterior.mode() - self.shift) * self.scale

    def _decode_frames(self, latents: Tensor) -> Tensor:
        raw = (latents / self.scale + self.shift).to(self.autoencoder.dtype)
        return self.autoencoder.decode(raw).sample / 2 + 0.5  # pyright: ignore

    def fingerprint(self) -> str:
        return fingerprint("flux", self.autoencoder)
