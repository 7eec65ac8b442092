"""Anti-aliased drawing with signed distances: a pixel's coverage follows from its distance."""

import numpy as np
from numpy.typing import NDArray

VIEW = 2.6  # width of the frame in metres; the pivot is at its centre
BOB_RADIUS = 0.16  # m
BACKGROUND, ROD, BOB = np.array([[235, 235, 230], [70, 75, 85], [210, 50, 40]], np.float64)


def draw(
    size: tuple[int, int], angle: float, length: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw the frame `[H, W, 3]` and its mask `[H, W]`: 0 background, 1 rod, 2 bob."""
    pixel = VIEW / size[1]
    y, x = (np.indices(size) - (np.array(size).reshape(2, 1, 1) - 1) / 2) * pixel
    along = np.array([np.sin(angle), np.cos(angle)])  # from the pivot to the bob; y points down
    nearest = np.clip(x * along[0] + y * along[1], 0, length)
    rod = np.hypot(x - nearest * along[0], y - nearest * along[1]) - 0.03
    bob = np.hypot(x - length * along[0], y - length * along[1]) - BOB_RADIUS
    frame, mask = np.broadcast_to(BACKGROUND, (*size, 3)), np.zeros(size, np.uint8)
    for instance, colour, distance in ((1, ROD, rod), (2, BOB, bob)):
        covered = np.clip(0.5 - distance / pixel, 0, 1)[..., None]
        frame = frame + covered * (colour - frame)
        mask[distance < 0] = instance
    return frame.round().astype(np.uint8), mask
