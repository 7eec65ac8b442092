"""What the channels of frames in arrays are: colours, opacity, or grey frames of several moments.

Agents of video games see the last three or four grey frames at once, stacked as channels. An array
does not say so, but a stack tells it by its content: each frame repeats those before it.
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

STACKED = "Frames are stacks of {count} grey frames; the newest is shown (--channels {channels})."


def channels_of(images: Sequence[Any], image: Callable[[Any], NDArray[Any]]) -> Channels:
    """What the channels of a recording's frames are, told by how frames follow each other.

    Args:
        images: its frames, of three or four channels.
        image: makes an array of one.

    Raises:
        DataError: four channels could be opacity as well as four moments.
    """
    last = first = opaque = True
    varied, count = False, 0
    pairs = np.linspace(0, max(0, len(images) - 2), min(max(len(images) - 1, 1), PLACES))
    for place in dict.fromkeys(pairs.astype(int).tolist()):
        one = channels_last(image(images[place]))
        two = channels_last(image(images[min(place + 1, len(images) - 1)]))
        count = two.shape[2]
        opaque = opaque and all(_is_full(image[..., -1]) for image in (one, two))
        if (two == two[..., :1]).all() and (one == one[..., :1]).all():
            continue  # grey: it does not tell moments from colours
        varied = True
        last = last and np.array_equal(two[..., :-1], one[..., 1:])
        first = first and np.array_equal(two[..., 1:], one[..., :-1])
        if not (last or first) and (count == 3 or not opaque):
            break
    if len(images) > 1 and varied and (last or first):
        return "newest-last" if last else "newest-first"
    if count == 3:
        return "rgb"
    if opaque:
        return "rgba"
    raise DataError(
        "its frames have four channels, which may be colours and opacity or four grey frames: give "
        "--channels rgba, newest-last or newest-first"
    )


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
