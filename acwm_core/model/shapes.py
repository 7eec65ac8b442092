"""Names of tensor shapes, used in every signature that takes or returns tensors.

Axes: B batch, T video frames, H W pixels, L latent frames, C latent channels, h w latent pixels,
A action dimensions, N tokens of one latent frame, D model width.

Conventions: video is float in [0, 1] at every public boundary. ``actions[:, i]`` leads from frame i
to frame i + 1, so T frames have T rows and the last row is zero. ``sigma`` is the noise level of a
latent frame: 0 is clean, 1 is noise.
"""

import contextlib
from collections.abc import Generator, Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from acwm_core.errors import DataError, ShapeError

Video = Float[Tensor, "B T 3 H W"]
"""Video in [0, 1]."""

Clip = Float[Tensor, "T 3 H W"]
"""One video in [0, 1], without the batch axis."""

Frame = Float[Tensor, "B 3 H W"]
"""One frame per batch element, in [0, 1]."""

Latent = Float[Tensor, "B L C h w"]
"""Codec output with zero mean and unit variance per channel."""

Actions = Float[Tensor, "B T A"]
"""Raw actions, in the units given on the environment card."""

Sigmas = Float[Tensor, "B L"]
"""Noise level per latent frame, in [0, 1]."""

Tokens = Float[Tensor, "B L N D"]
"""Patch tokens of each latent frame."""

Modulation = Float[Tensor, "B L D"]
"""One conditioning vector per latent frame."""


def check_finite(path: Path, weights: Mapping[str, Tensor]) -> None:
    """Refuse weights that are not finite: every prediction would be NaN.

    Raises:
        DataError: a tensor is not finite; names it.
    """
    for name, value in weights.items():
        if not value.isfinite().all():
            raise DataError(
                f"{path} holds weights that are not finite ({name}): use an earlier "
                "checkpoint, or train again with a lower learning rate"
            )


def check_pixels(video: Video) -> None:
    """Refuse frames that are not float in [0, 1].

    Raises:
        ShapeError: says how to convert them.
    """
    if not video.is_floating_point():
        raise ShapeError(f"frames are float in [0, 1], not {video.dtype}: take frames / 255")
    if not video.numel():
        raise ShapeError(f"there are no frames in {list(video.shape)}")
    low, high = (float(value) for value in video.aminmax())
    if not (low >= -1e-3 and high <= 1 + 1e-3):  # so NaN is refused, too
        raise ShapeError(
            f"frames must be in [0, 1], not in [{low:g}, {high:g}]: divide 8-bit values by 255, "
            "and clamp after resizing"
        )


@contextlib.contextmanager
def float32_by_default() -> Generator[None]:
    """Create tensors in float32, whatever the script has chosen by `torch.set_default_dtype`."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
