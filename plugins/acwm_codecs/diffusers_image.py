"""Any image autoencoder of diffusers, applied frame by frame, with normalised latents."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import torch
from diffusers.models.autoencoders.autoencoder_dc import AutoencoderDC
from diffusers.models.autoencoders.autoencoder_kl import AutoencoderKL
from diffusers.models.autoencoders.autoencoder_tiny import AutoencoderTiny
from torch import Tensor

from acwm_codecs.pretrained import fingerprint, load_autoencoder
from acwm_core.errors import DataError
from acwm_core.model.codec import Codec
from acwm_core.model.shapes import Latent, Video

FRAMES_AT_ONCE = 4
"""Frames per pass through the network, so that long clips need no more memory than short ones."""


class ImageAutoencoder(Codec):
    """An image autoencoder of diffusers, applied frame by frame.

    Latents are normalised by a mean and a standard deviation per channel: those given here (measure
    them on your own data with `measured`), or else those in the autoencoder's configuration.

    Args:
        weights: a hub repository or a folder in diffusers' layout, directly or in its folder `vae`.
        latent_mean: mean of the raw latents, one number per channel.
        latent_std: standard deviation of the raw latents, one number per channel.

    Raises:
        DataError: the weights do not exist, cannot be reached, or belong to another class; or mean
            and deviation are not one finite number per channel; or a deviation is not positive.
    """

    temporal_stride = 1
    memoryless = True
    name: ClassVar[str]
    kind: ClassVar[type[Any]]
    mean: Tensor
    deviation: Tensor

    def __init__(
        self,
        *,
        weights: str,
        latent_mean: tuple[float, ...] | None = None,
        latent_std: tuple[float, ...] | None = None,
    ) -> None:
        super().__init__()
        self.autoencoder = load_autoencoder(self.kind, weights, self.name).requires_grad_(False)
        config = self.autoencoder.config
        self.channels = config["latent_channels"]
        self.spatial_stride = self._stride(config)
        shift, scale = config.get("shift_factor") or 0.0, config.get("scaling_factor") or 1.0
        means = config.get("latents_mean") or [shift] * self.channels
        deviations = [d / scale for d in config.get("latents_std") or [1.0] * self.channels]
        mean = means if latent_mean is None else latent_mean
        deviation = deviations if latent_std is None else latent_std
        self.register_buffer("mean", self._numbers("latent_mean", mean), persistent=False)
        self.register_buffer("deviation", self._numbers("latent_std", deviation), persistent=False)
        if not (self.deviation > 0).all():
            raise DataError(f"codec.latent_std={list(deviation)}: give positive numbers")
        self.eval()

    @abstractmethod
    def _stride(self, config: Any) -> int:
        """Pixels per latent pixel."""

    @abstractmethod
    def _raw(self, pixels: Tensor) -> Tensor:
        """Raw latents `[N, C, h, w]` of pixels `[N, 3, H, W]` in [-1, 1]."""

    def _encode(self, video: Video) -> Latent:
        def latents(frames: Tensor) -> Tensor:
            return (self._raw(frames * 2 - 1) - self.mean) / self.deviation

        return _by_chunks(latents, video)

    def _decode(self, latents: Latent) -> Video:
        def pixels(frames: Tensor) -> Tensor:
            return self.autoencoder.decode(frames * self.deviation + self.mean).sample / 2 + 0.5

        return _by_chunks(pixels, latents)

    def fingerprint(self) -> str:
        numbers = [*self.mean.flatten().tolist(), *self.deviation.flatten().tolist()]
        return fingerprint(f"{self.name} {numbers}", self.autoencoder)

    def _numbers(self, name: str, values: Any) -> Tensor:
        """One number per channel, as `[C, 1, 1]`."""
        numbers = torch.tensor(values, dtype=torch.float32)
        if len(numbers) != self.channels or not numbers.isfinite().all():
            raise DataError(
                f"codec.{name}={list(values)}: give {self.channels} finite numbers, one per channel"
            )
        return numbers.view(-1, 1, 1)


class KL(ImageAutoencoder):
    """`AutoencoderKL`, as in Stable Diffusion; encoding takes the mean of the posterior."""

    name, kind = "autoencoder_kl", AutoencoderKL

    def _stride(self, config: Any) -> int:
        return 2 ** (len(config["block_out_channels"]) - 1)

    def _raw(self, pixels: Tensor) -> Tensor:
        return self.autoencoder.encode(pixels).latent_dist.mode()


class Tiny(ImageAutoencoder):
    """`AutoencoderTiny`, as in TAESD."""

    name, kind = "autoencoder_tiny", AutoencoderTiny

    def _stride(self, config: Any) -> int:
        return 2 ** (len(config["encoder_block_out_channels"]) - 1)

    def _raw(self, pixels: Tensor) -> Tensor:
        return self.autoencoder.encode(pixels).latents


class DC(ImageAutoencoder):
    """`AutoencoderDC`, as in SANA: strides of 32 or more (arXiv 2410.10733)."""

    name, kind = "autoencoder_dc", AutoencoderDC

    def _stride(self, config: Any) -> int:
        return 2 ** (len(config["encoder_block_out_channels"]) - 1)

    def _raw(self, pixels: Tensor) -> Tensor:
        return self.autoencoder.encode(pixels).latent


def measured(codec: ImageAutoencoder, videos: Iterable[Video]) -> dict[str, list[float]]:
    """Measure the `latent_mean` and `latent_std` that normalise the latents of these videos.

    Args:
        codec: the codec; its present normalisation is undone.
        videos: videos `[B, T, 3, H, W]` in [0, 1].

    Returns:
        The values with which these latents have mean 0 and variance 1 per channel.

    Raises:
        DataError: there is no video.
    """
    total, count = torch.zeros(2, codec.channels, dtype=torch.float64), 0
    with torch.no_grad():
        for video in videos:
            raw = codec.encode(video) * codec.deviation + codec.mean
            rows = raw.transpose(0, 2).flatten(1).double().cpu()
            total += torch.stack([rows.sum(1), rows.square().sum(1)])
            count += rows.shape[1]
    if not count:
        raise DataError("there is no video to measure latents on")
    mean, square = total / count
    return {"latent_mean": mean.tolist(), "latent_std": (square - mean**2).sqrt().tolist()}


def _by_chunks(compute: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    """Apply `compute` to frames `[B, T, …]`, a few at a time."""
    chunks = frames.flatten(0, 1).split(FRAMES_AT_ONCE)
    return torch.cat([compute(chunk) for chunk in chunks]).unflatten(0, frames.shape[:2])
