"""Structural similarity (Wang et al. 2004)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import ShapeError
from acwm_core.metric import Metric, Rollout

WINDOW = 7
"""Side of the uniform window, in pixels, as in the published evaluation."""

PIXELS = WINDOW * WINDOW

LUMINANCE, CONTRAST = 0.01**2, 0.03**2
"""The constants C₁ and C₂ that keep the quotients finite, of values in [0, 1] (ibid.)."""


class SSIM(Metric):
    """Structural similarity of each frame: uniform 7×7 window, mean over pixels and channels.

    What scikit-image's `structural_similarity` gives, to the last digits, in half its time: four
    windowed sums instead of five, of all channels at once.
    """

    name = "ssim"
    higher_is_better = True

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in [-1, 1].

        Raises:
            ShapeError: frames smaller than the window.
        """
        rollout.check_shapes()
        prediction, target = (
            clip.detach().cpu().numpy() for clip in (rollout.prediction, rollout.target)
        )
        height, width = target.shape[2:]
        if min(height, width) < WINDOW:
            raise ShapeError(f"SSIM needs frames of at least 7×7 pixels, not {height}×{width}")
        return np.array([similarity(*pair) for pair in zip(target, prediction, strict=True)])


def similarity(one: NDArray[Any], other: NDArray[Any]) -> float:
    """SSIM of two pictures `[3, H, W]` in [0, 1], by equation 13 of Wang et al. (2004)."""
    fields = np.empty((4, *one.shape))
    fields[:2] = one, other
    one, other = fields[:2]  # in double precision from here on
    fields[2] = one * one + other * other
    fields[3] = one * other
    mean, other_mean, squares, products = box_sums(fields) / PIXELS
    means, mean_squares = mean * other_mean, mean * mean + other_mean * other_mean
    unbiased = PIXELS / (PIXELS - 1)
    covariance, variances = unbiased * (products - means), unbiased * (squares - mean_squares)
    alike = (2 * means + LUMINANCE) * (2 * covariance + CONTRAST)
    return float((alike / ((mean_squares + LUMINANCE) * (variances + CONTRAST))).mean())


def box_sums(fields: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums over all windows that lie within `[…, H, W]`: `[…, H − 6, W − 6]`.

    Of 7 = 4 + 2 + 1 neighbours down, then across.
    """
    height, width = (side - WINDOW + 1 for side in fields.shape[-2:])
    twos = fields[..., :-1, :] + fields[..., 1:, :]
    sums = twos[..., :height, :] + twos[..., 2 : 2 + height, :]
    sums += twos[..., 4 : 4 + height, :]
    sums += fields[..., 6:, :]
    twos = sums[..., :-1] + sums[..., 1:]
    windows = twos[..., :width] + twos[..., 2 : 2 + width]
    windows += twos[..., 4 : 4 + width]
    windows += sums[..., 6:]
    return windows
