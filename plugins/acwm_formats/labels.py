"""Ground truth of frames that recordings rarely have: instance masks and contacts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_formats.frames import Images


@dataclass(frozen=True)
class Labels:
    """Labels of the frames of a recording's first camera.

    Attributes:
        masks: for each frame the instance ids of its pixels, ``[H, W]`` uint8.
        contacts: rows (frame, id, id), ``[N, 3]`` int32.
    """

    masks: Images
    contacts: NDArray[np.int32]

    def masks_of(
        self, frames: NDArray[np.int64], size: tuple[int, int]
    ) -> Iterator[NDArray[np.uint8]]:
        """The masks of some frames of height and width `size`.

        Raises:
            DataError: a mask is no uint8 array of that size.
        """
        for index in frames.tolist():
            mask = np.asarray(self.masks[index])
            if mask.dtype != np.uint8 or mask.shape != size:
                what = f"{mask.dtype} {mask.shape}, not uint8 {size}"
                raise DataError(f"the mask of frame {index} is {what}")
            yield mask

    def contacts_of(self, frames: NDArray[np.int64]) -> NDArray[np.int32]:
        """The contacts in some frames, which are numbered by their place among them."""
        contacts = [self.contacts[self.contacts[:, 0] == frame] for frame in frames.tolist()]
        rows = np.concatenate(contacts).astype(np.int32)
        rows[:, 0] = np.repeat(np.arange(len(contacts)), [len(part) for part in contacts])
        return rows
