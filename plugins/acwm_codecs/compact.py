"""`Compact` and `Fine`: small causal video autoencoders whose weights ship with the package.

They fold the four video frames of each latent frame into channels (the first video frame is
repeated four times) and apply two-dimensional convolutions. So latent frames are independent of
each other, and the encoding of a prefix is the prefix of the encoding.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from acwm_core.errors import DataError
from acwm_core.files import check_fetched
from acwm_core.model.codec import Codec
from acwm_core.model.shapes import Frame, Latent, Video, check_finite

WEIGHTS = Path(__file__).parent / "weights"

STRIDE = 4
"""Video frames folded into one latent frame."""


class ResidualBlock(nn.Module):
    """A residual block: two 3×3 convolutions with SiLU before each; starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, features: Tensor) -> Tensor:
        """Apply the block to features `[N, C, H, W]`; the shape stays the same."""
        silu = nn.functional.silu
        return features + self.second(silu(self.first(silu(features))))


def make_encoder(widths: Sequence[int], channels: int) -> nn.Sequential:
    """Make the encoder, which maps `[N, 12, H, W]` to `[N, channels, h, w]`.

    Args:
        widths: channels at 1/2, 1/4, … of the frame's resolution, down to that of the latent.
        channels: channels of the latent.
    """
    layers: list[nn.Module] = []
    for before, width in zip((3 * STRIDE, *widths), widths, strict=False):
        blocks = 2 if width == widths[-1] else 1
        layers += [nn.Conv2d(before, width, 4, stride=2, padding=1)]
        layers += [*(ResidualBlock(width) for _ in range(blocks)), nn.SiLU()]
    return nn.Sequential(*layers, nn.Conv2d(widths[-1], channels, 1))


def make_decoder(widths: Sequence[int], channels: int) -> nn.Sequential:
    """Make the decoder, which maps `[N, channels, h, w]` to `[N, 12, H, W]`; see `make_encoder`."""
    coarse, *finer = reversed(widths)
    layers: list[nn.Module] = [nn.Conv2d(channels, coarse, 3, padding=1)]
    layers += [ResidualBlock(coarse) for _ in range(3)]
    for before, width in zip((coarse, *finer), finer, strict=False):
        layers += [nn.Conv2d(before, 4 * width, 3, padding=1), nn.PixelShuffle(2)]
        layers += [ResidualBlock(width) for _ in range(2)]
    last = nn.Conv2d(widths[0], 4 * 3 * STRIDE, 3, padding=1)
    return nn.Sequential(*layers, nn.SiLU(), last, nn.PixelShuffle(2))


class Compact(Codec):
    """``compact``: strides 8×8×4, 16 latent channels and about 5 M parameters.

    Args:
        weights: a safetensors file; by default the one that ships with the package. `random` keeps
            the initial weights, for training.

    Raises:
        DataError: the file does not exist or does not hold the weights of this codec.
    """

    name = "compact"
    widths: tuple[int, ...] = (64, 128, 160)
    """Channels at 1/2, 1/4, … of the frame's resolution, down to that of the latent."""

    channels = 16
    spatial_stride = 8
    temporal_stride = STRIDE
    memoryless = True
    # The error is 0.3 % of the latents' standard deviation, in less than half the time.
    encodes_in_bfloat16 = True

    def __init__(self, *, weights: str | None = None) -> None:
        super().__init__()
        self._make_layers()
        if weights != "random":
            self._load(Path(weights) if weights else self.shipped_weights())
            self.eval()  # normalise with trained statistics, not with those of the batch
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def _make_layers(self) -> None:
        """Make the layers, whose weights are loaded afterwards."""
        self.encoder = make_encoder(self.widths, self.channels)
        self.decoder = make_decoder(self.widths, self.channels)
        # Without affine parameters its running statistics are the latent's mean and variance:
        # normalisation is learned during training and fixed in evaluation.
        self.normalise = nn.BatchNorm2d(self.channels, affine=False)

    @classmethod
    def shipped_weights(cls) -> Path:
        """The file of the weights that ship."""
        return WEIGHTS / f"{cls.name}.safetensors"

    def stored(self) -> dict[str, Tensor]:
        """The weights as files have them, in half precision."""
        return {
            name: value.half().contiguous() if value.is_floating_point() else value
            for name, value in self.state_dict().items()
        }

    def _read(self, path: Path) -> dict[str, Tensor]:
        """All weights that a file stands for."""
        return load_file(path)

    def _load(self, path: Path) -> None:
        try:
            state = self._read(path)
            self.load_state_dict({name: value.float() for name, value in state.items()})
        except FileNotFoundError:
            raise DataError(f"codec '{self.name}': there is no weights file {path}") from None
        except (SafetensorError, RuntimeError) as error:
            check_fetched(path)
            what = str(error).splitlines()[0]
            raise DataError(
                f"codec '{self.name}': {path} does not hold its weights ({what})"
            ) from error
        check_finite(path, state)

    def _encode(self, video: Video) -> Latent:
        return self.normalise(self.encoder(fold(video) * 2 - 1)).unflatten(0, (video.shape[0], -1))

    def _decode(self, latents: Latent) -> Video:
        return unfold(self._groups(latents))

    def _decode_later(self, latents: Latent) -> Video:
        return frames_of(self._groups(latents))

    def _groups(self, latents: Latent) -> Tensor:
        """Decode `[B, L, C, h, w]` to `[B, L, 12, H, W]` in [0, 1]."""
        return self.decode_groups(latents.flatten(0, 1)).unflatten(0, latents.shape[:2])

    def decode_groups(self, latents: Tensor, reference: Frame | None = None) -> Tensor:
        """Decode latent frames `[N, C, h, w]` to groups of four frames `[N, 12, H, W]` in [0, 1].

        Args:
            latents: latent frames.
            reference: a frame before each, `[N, 3, H, W]` in [0, 1]; not looked at here.
        """
        return self.decoder(latents).float() / 2 + 0.5

    def fingerprint(self) -> str:
        digest = hashlib.sha256(self.name.encode())
        for name, value in sorted(self.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()[:12]


class Fine(Compact):
    """``fine``: strides 4×4×4, 16 latent channels and about 1.9 M parameters.

    It has no third level, so objects of a few pixels keep their shape. A model that reads 2×2 of
    its cells as one, by ``model.patch_size=2``, costs as much as one on `Compact`.

    Args:
        weights: see `Compact`.
    """

    name = "fine"
    widths = (64, 128)
    spatial_stride = 4


def fold(video: Video) -> Tensor:
    """Fold `[B, 1 + 4k, 3, H, W]` to `[B · (1 + k), 12, H, W]`; frame 0 is repeated four times."""
    first = video[:, :1].expand(-1, STRIDE, -1, -1, -1)
    frames = torch.cat([first, video[:, 1:]], dim=1)
    groups = frames.unflatten(1, (-1, STRIDE)).flatten(2, 3).flatten(0, 1)
    return groups.contiguous(memory_format=torch.channels_last)


def unfold(groups: Tensor) -> Video:
    """The inverse of `fold`, from `[B, 1 + k, 12, H, W]`; the first four frames are averaged."""
    frames = frames_of(groups)
    return torch.cat([frames[:, :STRIDE].mean(1, keepdim=True), frames[:, STRIDE:]], dim=1)


def frames_of(groups: Tensor) -> Video:
    """All frames in `[B, k, 12, H, W]`, as `[B, 4k, 3, H, W]`."""
    return groups.unflatten(2, (STRIDE, 3)).flatten(1, 2)
