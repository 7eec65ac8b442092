"""Pixels of any origin as uint8 RGB, and frames averaged down."""

from __future__ import annotations

import functools
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from acwm_core.env.environment import resolve_size
from acwm_core.errors import DataError

MIN_SIDE = 16
CHANNELS = (1, 3, 4)


def loaded(image: Any) -> NDArray[Any]:
    """A frame ``[H, W]`` or ``[H, W, C]`` from an array, the path of a picture, or its bytes.

    Raises:
        DataError: it cannot be read, or is no image.
    """
    if isinstance(image, str | Path | bytes):
        return _picture(image)
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] not in CHANNELS and array.shape[0] in CHANNELS:
        array = np.moveaxis(array, 0, 2)  # [C, H, W]
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in CHANNELS):
        raise DataError(f"a frame is {array.dtype} {array.shape}, not [H, W, 3]")
    return array


def _picture(source: str | Path | bytes) -> NDArray[Any]:
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    try:
        with Image.open(file) as opened:
            image: Any = ImageOps.exif_transpose(opened)
            if image.mode.startswith("I;16"):
                return np.asarray(image).astype(np.uint16)
            if image.mode in ("L", "F", "I"):
                return np.asarray(image)
            return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    except (OSError, ValueError, TypeError, SyntaxError, Image.DecompressionBombError) as error:
        where = "a picture" if isinstance(source, bytes) else f"the picture {source}"
        raise DataError(f"{where} cannot be read ({error})") from error


def is_depth(image: NDArray[Any]) -> bool:
    """Whether an image is a depth map: one channel of more than 8 bits."""
    return image.ndim == 2 and image.dtype.itemsize > 1


def depth_as_grey(
    metres: NDArray[Any], depth_range: tuple[float, float] | None, name: str
) -> NDArray[np.uint8]:
    """A depth map ``[H, W]`` in metres as ``[H, W, 3]`` uint8.

    The nearest distance of the range is white, the farthest black, and so is what was not measured:
    zero and numbers that are not finite.

    Raises:
        DataError: there is no range.
    """
    if depth_range is None:
        raise DataError(
            f"{name} is a depth map: give --depth-range NEAR,FAR in metres, or another --camera"
        )
    near, far = depth_range
    seen = np.isfinite(metres) & (metres > 0)
    share = (far - np.where(seen, metres, far).astype(np.float64)) / (far - near)
    grey = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def as_rgb(image: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """An image ``[H, W]`` or ``[H, W, C]`` as ``[H, W, 3]`` uint8; alpha is laid over black.

    Raises:
        DataError: its numbers are no colours that are known.
    """
    kind, rows = image.dtype.kind, image
    if rows.dtype == np.uint16:
        rows = np.rint(rows / 257).astype(np.uint8)
    elif kind == "f":
        if not np.all((rows >= 0) & (rows <= 1)):
            raise DataError(f"{name} has {rows.dtype} pixels outside 0 … 1: convert it to uint8")
        rows = np.rint(rows.astype(np.float64) * 255).astype(np.uint8)
    elif kind == "b":
        rows = rows.astype(np.uint8) * 255
    elif rows.dtype != np.uint8:
        if kind not in "iu" or rows.min(initial=0) < 0 or rows.max(initial=0) > 255:
            raise DataError(f"{name} has {rows.dtype} pixels outside 0 … 255: convert it to uint8")
        rows = rows.astype(np.uint8)
    if rows.ndim == 2:
        return np.repeat(rows[..., None], 3, axis=2)
    return over_black(rows) if rows.shape[2] == 4 else rows


def over_black(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lay RGBA over black."""
    if image[..., 3].min(initial=255) == 255:
        return np.ascontiguousarray(image[..., :3])
    colours = image[..., :3].astype(np.uint16) * image[..., 3:]
    return np.rint(colours / 255).astype(np.uint8)


def target_size(
    found: tuple[int, int], size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """The frame size ``(H, W)`` of a dataset whose videos have the size `found`.

    Args:
        found: size of the videos.
        size: the requested size, a side or a pair; by default `found`, each side rounded down to a
            multiple of 8.

    Raises:
        DataError: the videos are smaller than the requested size, or than 16 pixels.
        ShapeError: a side is not a multiple of 8, or below 16.
    """
    whole = (found[0] // 8 * 8, found[1] // 8 * 8)
    if min(whole) < MIN_SIDE:
        raise DataError(f"frames of {found[0]}×{found[1]} are too small: a side needs {MIN_SIDE}")
    wanted = resolve_size(size, whole)
    if wanted[0] > found[0] or wanted[1] > found[1]:
        raise DataError(
            f"frames of {found[0]}×{found[1]} cannot be enlarged to {wanted[0]}×{wanted[1]}: "
            "give a smaller --size"
        )
    return wanted


def shrunk(frame: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Average a frame ``[H, W, 3]`` down: each new pixel is the mean of the area that it covers."""
    if frame.shape[:2] == size:
        return frame
    rows = _averaged(frame.astype(np.float32), size[0])
    means = _averaged(rows.swapaxes(0, 1), size[1]).swapaxes(0, 1)
    return np.rint(means).astype(np.uint8)


def _averaged(image: NDArray[np.float32], length: int) -> NDArray[np.float32]:
    """The mean of `image` over `length` equal intervals of its first axis."""
    total = np.zeros((length, *image.shape[1:]), np.float32)
    for index, weight in zip(*_intervals(len(image), length), strict=True):
        total += image[index] * weight[:, None, None]
    return total


@functools.cache
def _intervals(old: int, new: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """For each interval, the samples that it touches and their shares in it, both ``[K, new]``."""
    edges = np.arange(new + 1) * (old / new)
    touched = np.arange(int(np.ceil(old / new)) + 1)[:, None]
    indices = np.floor(edges[:-1]).astype(np.int64) + touched
    shares: NDArray[Any] = np.minimum(indices + 1, edges[1:]) - np.maximum(indices, edges[:-1])
    weights = np.clip(shares, 0, None)
    return np.minimum(indices, old - 1), (weights / weights.sum(0)).astype(np.float32)
