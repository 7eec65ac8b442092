"""Images of any kind as colours of 8 bits: grey, alpha, 16 bits, float, channels first, depth."""

from __future__ import annotations

import contextlib
import io
import struct
import warnings
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from acwm_core.data.video import MOST_PIXELS
from acwm_core.errors import AcwmError, AcwmWarning, DataError
from acwm_core.files import check_fetched

CHANNELS = (1, 3, 4)
"""Numbers of channels that an image has: grey or depth, colours, colours and opacity."""

KINDS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
"""Pictures that are read, by Pillow's names. Others that it opens are programs (EPS is run by
Ghostscript), so the kinds are always named; the first bytes tell which one it is, not its name."""

MOST_BYTES = 16 * MOST_PIXELS
"""Bytes of a frame in an array: four channels of four bytes."""

SQUEEZED = 0.02
"""A picture whose sides have another ratio than the frames, by so much, is not used silently."""

_DAMAGED = (
    *(OSError, ValueError, SyntaxError, EOFError, LookupError, TypeError, ArithmeticError),
    *(RuntimeError, MemoryError, struct.error, Image.DecompressionBombError),
)
"""What Pillow raises for pictures that are damaged or forged."""


def channels_last(image: NDArray[Any]) -> NDArray[Any]:
    """An image as ``[H, W, C]``; it may be ``[H, W]``, ``[C, H, W]`` or ``[H, W, C]``.

    Raises:
        DataError: it is no image, or could be read both ways.
    """
    if image.ndim == 2:
        return image[..., None]
    if image.ndim == 4:
        raise DataError(stacked("an array of five axes", image.shape))
    first, last = image.ndim == 3 and image.shape[0] in CHANNELS, image.shape[-1] in CHANNELS
    if image.ndim != 3 or first == last:
        raise DataError(f"an image is {image.shape}, not [H, W], [H, W, C] or [C, H, W]")
    return np.moveaxis(image, 0, 2) if first else image


def stacked(what: str, shape: tuple[int, ...]) -> str:
    """Why an array whose frames have four axes is not read."""
    return (
        f"{what} stacks whole episodes, or several cameras, as its frames are {list(shape)}: store "
        "[T, H, W, C], a group or file for each episode, or all in a row with ep_len beside, and "
        "an array per camera"
    )


def is_depth(image: NDArray[Any]) -> bool:
    """Whether an image holds distances: one channel of more than 8 bits."""
    return channels_last(image).shape[2] == 1 and image.dtype.itemsize > 1


def to_rgb(
    image: NDArray[Any],
    *,
    depth_range: tuple[float, float] | None = None,
    pixel_range: tuple[float, float] | None = None,
) -> NDArray[np.uint8]:
    """Convert an image to ``[H, W, 3]`` uint8.

    Colours with opacity are laid on black. One channel of whole numbers of more than 8 bits is
    depth in millimetres, and one of floats is depth in metres.

    Args:
        depth_range: the distances in metres that become white and black; what is nearer or farther
            is cut, and what was not measured (0 or not finite) is black.
        pixel_range: the values that become black and white, for floats and 16-bit colours.

    Raises:
        DataError: it is no image, or an option is needed to read it.
    """
    pixels = channels_last(image)
    if is_depth(pixels):
        grey = _nearness(pixels[..., 0], depth_range)
        return np.repeat(grey[..., None], 3, axis=2)
    if pixels.dtype != np.uint8:
        pixels = _eight_bits(pixels, pixel_range)
    if pixels.shape[2] == 4:
        opacity = pixels[..., 3:].astype(np.uint16)
        pixels = ((pixels[..., :3] * opacity + 127) // 255).astype(np.uint8)
    return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else np.ascontiguousarray(pixels)


def guessed_range(image: NDArray[Any]) -> tuple[float, float] | None:
    """The `pixel_range` of all images, judged by the first; None if they are bytes or depth.

    Floats up to 1, or whole floats up to 255, speak for themselves. An image beyond the range is
    refused later, by `to_rgb`.

    Raises:
        DataError: it cannot be told.
    """
    if image.dtype in (np.uint8, bool) or is_depth(image):
        return None
    least, most = float(image.min()), float(image.max())
    whole = not np.any(np.asarray(image, np.float64) % 1)
    if image.dtype.kind == "f" and least >= 0:
        if most <= 1 and not whole:
            return (0, 1)
        if 1 < most <= 255 and whole:
            return (0, 255)
    raise _unclear(image)


def _unclear(image: NDArray[Any]) -> DataError:
    return DataError(
        f"its colours are {image.dtype} from {image.min():g} to {image.max():g}: give "
        "--pixel-range BLACK,WHITE, e.g. 0,1 or 0,255 or 0,65535"
    )


def _nearness(depth: NDArray[Any], span: tuple[float, float] | None) -> NDArray[np.uint8]:
    if span is None:
        raise DataError("it is a depth map: give --depth-range NEAR,FAR in metres")
    metres = depth.astype(np.float32) * (1.0 if depth.dtype.kind == "f" else 1e-3)
    near, far = span
    measured = np.isfinite(metres) & (metres > 0)
    share = (far - np.where(measured, metres, far)) / (far - near)
    return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)


def _eight_bits(image: NDArray[Any], span: tuple[float, float] | None) -> NDArray[np.uint8]:
    if image.dtype == bool:
        return image.astype(np.uint8) * np.uint8(255)
    if span is None:
        raise _unclear(image)
    black, white = span
    if not black <= image.min() <= image.max() <= white:
        raise DataError(
            f"its colours reach from {image.min():g} to {image.max():g}, beyond {black:g} to "
            f"{white:g}: give another --pixel-range"
        )
    return np.rint((image.astype(np.float32) - black) * (255 / (white - black))).astype(np.uint8)


def read_image(source: Path | bytes) -> NDArray[Any]:
    """Read a picture of one of `KINDS` as it is stored, upright: `to_rgb` converts it.

    Raises:
        DataError: it is missing, damaged, too large or of another kind, or holds several pictures.
    """
    with opened_picture(source) as opened:
        _check_single(source, opened)
        return _stored(opened)


def picture_of_size(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a picture as a frame `[H, W, 3]` of this size; warns if it gets other proportions.

    Raises:
        DataError: see `opened_picture`.
    """
    height, width = size
    with opened_picture(path, (*KINDS, "GIF")) as picture:
        if abs(picture.height * width / (picture.width * height) - 1) > SQUEEZED:
            warnings.warn(
                f"{path} is squeezed from {picture.height}×{picture.width} to {height}×{width} "
                "pixels: crop it first to keep its proportions",
                AcwmWarning,
                stacklevel=2,
            )
        resized = picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    return np.asarray(resized)


@contextlib.contextmanager
def opened_picture(source: Path | bytes, kinds: tuple[str, ...] = KINDS) -> Generator[Image.Image]:
    """Open a picture of one of some kinds; what goes wrong in the block becomes a `DataError`.

    Raises:
        DataError: it is missing, damaged, of another kind, or has more than `MOST_PIXELS`.
    """
    what = source if isinstance(source, Path) else "an image"
    if isinstance(source, Path):
        check_fetched(source)
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    try:
        with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
            opened = Image.open(file, formats=kinds)
        with opened:
            check_pixels(what, opened.height, opened.width)
            yield opened
    except AcwmError:
        raise
    except FileNotFoundError:
        raise DataError(f"there is no {source}") from None
    except UnidentifiedImageError:
        raise DataError(f"{what} is not a picture in {', '.join(kinds)}") from None
    except _DAMAGED as error:
        raise DataError(f"{what} cannot be read ({error or type(error).__name__})") from error


def _check_single(source: Path | bytes, opened: Image.Image) -> None:
    """Refuse a file of several pictures, of which the first would be taken.

    In a JPEG, others are previews and maps of a phone's camera.
    """
    what = source if isinstance(source, Path) else "an image"
    count = 1 if opened.format in ("JPEG", "MPO") else getattr(opened, "n_frames", 1)
    if count > 1:
        raise DataError(f"{what} holds {count} pictures: write each into a file of its own")


def check_pixels(what: object, height: int, width: int) -> None:
    """Refuse a frame of more than `MOST_PIXELS`.

    Args:
        what: whose frame, for the message.

    Raises:
        DataError: it has more.
    """
    if height * width > MOST_PIXELS:
        raise DataError(
            f"{what} claims {height}×{width} pixels, but at most {MOST_PIXELS:,} are read"
        )


def _stored(opened: Image.Image) -> NDArray[Any]:
    upright = ImageOps.exif_transpose(opened)
    if upright.mode.startswith(("I", "F")):
        values = np.asarray(upright)
        return values.astype(np.uint16) if values.dtype.kind == "i" else values
    if upright.mode in ("1", "L"):
        return np.asarray(upright.convert("L"))
    clear = upright.has_transparency_data
    return np.asarray(upright.convert("RGBA" if clear else "RGB"))
