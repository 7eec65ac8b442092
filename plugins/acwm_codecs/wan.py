"""`Wan` and `WanPerFrame`: the video autoencoder of Wan 2.1, with its published weights."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers.loaders.single_file_utils import convert_wan_vae_to_diffusers
from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan, WanCausalConv3d
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from acwm_codecs.pretrained import build, fingerprint, first_line, load_autoencoder, load_strictly
from acwm_core.errors import DataError
from acwm_core.files import check_fetched
from acwm_core.model.codec import Codec, FrameDecoder
from acwm_core.model.shapes import Latent, Video

HUB = "Wan-AI/Wan2.1-T2V-1.3B-Diffusers"
"""The default repository; its folder `vae` is used."""

WAN_2_2_CHANNELS = 48


class Wan(Codec):
    """The causal autoencoder of Wan 2.1 (arXiv 2503.20314): strides 8×8×4, 16 channels.

    It has 127 M parameters. Clips are processed one at a time, four frames after four, so memory
    grows with the frame size only. Encoding takes the mean of the posterior.

    Args:
        weights: a hub repository or a folder in diffusers' layout, directly or in its folder
            `vae`, or a single file of the original release (`Wan2.1_VAE.pth`).

    Raises:
        DataError: the weights do not exist, cannot be reached, or belong to another codec.
    """

    mean: Tensor
    deviation: Tensor
    temporal_stride = 4
    name = "wan"

    def __init__(self, *, weights: str = HUB) -> None:
        super().__init__()
        load = _load_single_file if Path(weights).is_file() else _load_folder
        self.autoencoder = load(weights, self.name).requires_grad_(False)
        configuration = self.autoencoder.config
        self.channels = configuration["z_dim"]
        self.spatial_stride = 2 ** (len(configuration["dim_mult"]) - 1)
        self.register_buffer("mean", self._statistics("latents_mean"), persistent=False)
        self.register_buffer("deviation", self._statistics("latents_std"), persistent=False)
        self.eval()

    def _encode(self, video: Video) -> Latent:
        return torch.stack([self._encode_clip(clip) for clip in video])

    def _decode(self, latents: Latent) -> Video:
        return torch.stack([self._decode_clip(clip) for clip in latents])

    def _encode_clip(self, frames: Tensor) -> Tensor:
        """Encode one clip `[T, 3, H, W]` as `[L, C, h, w]`."""
        pixels = (frames * 2 - 1).transpose(0, 1)[None].to(self.autoencoder.dtype)
        posterior = self.autoencoder.encode(pixels).latent_dist  # pyright: ignore
        return (posterior.mode()[0].transpose(0, 1) - self.mean) / self.deviation

    def _decode_clip(self, latents: Tensor) -> Tensor:
        """Decode one clip `[L, C, h, w]` to `[T, 3, H, W]`."""
        return self._causal_decoder()(latents[None])[0]

    def _frame_decoder(self) -> FrameDecoder:
        return self._causal_decoder()

    def _causal_decoder(self) -> FrameDecoder:
        """A decoder with memory: each convolution looks back two frames and keeps only these."""
        decoder, memory = self.autoencoder.decoder, self._no_memory()

        def decode_one(latent: Latent) -> Tensor:
            raw = (latent * self.deviation + self.mean).transpose(1, 2)
            raw = self.autoencoder.post_quant_conv(raw.to(self.autoencoder.dtype))
            first = memory[0] is None
            frames = decoder(raw, feat_cache=memory, feat_idx=[0], first_chunk=first)
            return frames.transpose(1, 2) / 2 + 0.5

        return lambda latents: torch.cat([decode_one(latent) for latent in latents.split(1, 1)], 1)

    def _no_memory(self) -> list[Tensor | None]:
        """An empty `feat_cache` of diffusers, with one entry per causal convolution."""
        modules = self.autoencoder.decoder.modules()
        return [None for module in modules if isinstance(module, WanCausalConv3d)]

    def fingerprint(self) -> str:
        """Hash of configuration and weights, independent of the file format."""
        return fingerprint(self.name, self.autoencoder)

    def _statistics(self, name: str) -> Tensor:
        """One number per channel, as `[C, 1, 1]`."""
        given = self.autoencoder.config[name]
        numbers = isinstance(given, list) and all(isinstance(n, (int, float)) for n in given)
        if not numbers or len(given) != self.channels:
            raise DataError(
                f"codec {self.name!r}: {name} of its configuration must be {self.channels} numbers"
            )
        return torch.tensor(given, dtype=torch.float32).view(-1, 1, 1)


class WanPerFrame(Wan):
    """The same autoencoder with every frame encoded by itself: strides 8×8, 16 channels.

    Args:
        weights: see `Wan`.
    """

    temporal_stride = 1
    memoryless = True
    name = "wan_per_frame"

    def _encode(self, video: Video) -> Latent:
        return super()._encode(_as_clips(video)).unflatten(0, video.shape[:2]).squeeze(2)

    def _decode(self, latents: Latent) -> Video:
        return super()._decode(_as_clips(latents)).unflatten(0, latents.shape[:2]).squeeze(2)

    def _frame_decoder(self) -> FrameDecoder:
        return Codec._frame_decoder(self)


def _as_clips(frames: Tensor) -> Tensor:
    """Turn `[B, T, …]` into `[B · T, 1, …]`, with every frame as its own clip."""
    return frames.flatten(0, 1).unsqueeze(1)


def _load_folder(weights: str, codec: str) -> AutoencoderKLWan:
    def check(configuration: Mapping[str, Any]) -> None:
        halves = configuration.get("temperal_downsample", [False, True, True])
        patches = bool(configuration.get("patch_size"))
        if patches or (isinstance(halves, list) and halves.count(True) != 2):
            raise _another(codec, weights, version=patches)

    return load_autoencoder(AutoencoderKLWan, weights, codec, check)


def _another(codec: str, weights: str, *, version: bool) -> DataError:
    """The error for weights of Wan 2.2 (`version`), which cuts frames into patches, or others."""
    found = "Wan 2.2, which has 48 channels and strides 16×16×4" if version else "another model"
    return DataError(
        f"codec {codec!r} is the autoencoder of Wan 2.1, and {weights} holds that of {found}: "
        f"leave out codec.weights, or set it to one of Wan 2.1 such as {HUB}"
    )


def _load_single_file(weights: str, codec: str) -> AutoencoderKLWan:
    """Load a file of the original release; renames its tensors and infers widths from them."""
    path = Path(weights)
    try:
        state = _read_tensors(path)
        if len(state.get("conv2.weight", ())) == WAN_2_2_CHANNELS:
            raise _another(codec, weights, version=True)
        widths = {
            "base_dim": len(state["encoder.conv1.weight"]),
            "z_dim": len(state["conv2.weight"]),
        }
        converted = convert_wan_vae_to_diffusers(state)
    except KeyError as error:
        raise DataError(f"codec {codec!r}: {path} lacks {error.args[0]}") from None
    except (OSError, RuntimeError, ValueError, EOFError, SafetensorError) as error:
        check_fetched(path)
        raise DataError(f"codec {codec!r}: {path} cannot be read: {first_line(error)}") from None
    except pickle.UnpicklingError:
        check_fetched(path)
        raise DataError(
            f"codec {codec!r}: {path} holds something other than tensors, or nothing, and is not "
            "opened"
        ) from None
    autoencoder = build(AutoencoderKLWan, widths, path, codec)
    load_strictly(autoencoder, converted, path, codec)
    return autoencoder


def _read_tensors(path: Path) -> dict[str, Tensor]:
    """Read tensors by name; code in a pickle is never run."""
    if path.suffix == ".safetensors":
        return load_file(path)
    state = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError("it is not a dictionary of tensors")
    return state
