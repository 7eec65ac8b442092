"""What the channels of frames in arrays are: colours, opacity, or grey frames of several moments.

Agents of video games see the last three or four grey frames at once, stacked as channels. An array
does not say so, but the content of a stack shows it: each frame repeats those before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_formats.images import channels_last

Channels = Literal["rgb", "rgba", "newest-last", "newest-first"]
"""Names of what three or four channels are, as ``--channels`` takes them."""

PLACES = 16  # pairs of frames that are compared, at most

APART = range(1, 5)
"""Frames from one moment of a stack to the next."""

STACKED = "Frames are stacks of {count} grey frames; the newest is shown (--channels {channels})."


def channels_of(images: Sequence[Any], image: Callable[[Any], NDArray[Any]]) -> Channels:
    """What the channels of a recording's frames are, told by how frames follow each other.

    Args:
        images: its frames, of three or four channels.
        image: makes an array of one.

    Raises:
        DataError: four channels could be opacity as well as four moments.
    """
    for apart in APART:
        if stacked := _stacked(images, image, apart):
            return stacked
    chosen = np.linspace(0, len(images) - 1, min(len(images), PLACES)).astype(int).tolist()
    if channels_last(image(images[0])).shape[2] == 3:
        return "rgb"
    if all(_is_full(channels_last(image(images[place]))[..., -1]) for place in chosen):
        return "rgba"
    raise DataError(
        "its frames have four channels, which may be colours and opacity or four grey frames: give "
        "--channels rgba, newest-last or newest-first"
    )


def _stacked(
    images: Sequence[Any], image: Callable[[Any], NDArray[Any]], apart: int
) -> Channels | None:
    """The order of moments that are so many frames apart, if each channel is one."""
    last = first = True
    varied, most = False, len(images) - apart
    for place in dict.fromkeys(np.linspace(0, most - 1, min(max(most, 0), PLACES)).astype(int)):
        one, two = (channels_last(image(images[n])) for n in (place, place + apart))
        if (two == two[..., :1]).all() and (one == one[..., :1]).all():
            continue  # grey: it does not tell moments from colours
        varied = True
        last = last and np.array_equal(two[..., :-1], one[..., 1:])
        first = first and np.array_equal(two[..., 1:], one[..., :-1])
        if not (last or first):
            return None
    if not varied:
        return None
    return "newest-last" if last else "newest-first"


def _is_full(values: NDArray[Any]) -> bool:
    if values.dtype.kind in "ui":
        return bool((values == np.iinfo(values.dtype).max).all())
    return bool((values == values.flat[0]).all()) and float(values.flat[0]) in (1.0, 255.0)


def named(name: str, channels: Channels | None) -> Channels | None:
    """What the user says that channels are, or the name of their array."""
    return channels or ("rgba" if "rgba" in name.lower() else None)


def coloured(image: NDArray[Any], channels: Channels) -> NDArray[Any]:
    """A frame of three or four channels as colours: of a stack, the newest moment in grey."""
    pixels = channels_last(image)
    if channels in ("rgb", "rgba"):
        return pixels
    newest = pixels[..., -1:] if channels == "newest-last" else pixels[..., :1]
    return np.repeat(newest, 3, axis=2)
