"""Squared-error metrics, as in ACWM-Phys (arXiv 2605.08567)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.metric import Metric, Numbers, Rollout
from acwm_core.shapes import Clip

MOTION_FLOOR = 0.01
"""Weight of a pixel that never changes, in M-MSE."""

ERROR_FLOOR = 1e-8
"""Added to the MSE before PSNR's logarithm, as published: a perfect clip has 80 dB."""


class MSE(Metric):
    """Mean squared error over pixels and channels, of values in [0, 1]."""

    name = "mse"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`."""
        return rollout.squared_error.mean((1, 2), dtype=np.float64)


class MaskedMSE(Metric):
    """M-MSE: squared error weighted by how much each pixel moves in the true video.

    w = 0.01 + max over frames and channels of |target − target's first frame|, one weight per
    pixel of the clip; the error is Σ w·(prediction − target)² / Σ w. The clip's value is the mean
    of its frames, since all of them share the weights.
    """

    name = "m_mse"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`."""
        errors, weights = rollout.squared_error, _weights_of(rollout)
        return np.einsum("thw,hw->t", errors, weights, dtype=np.float64) / weights.sum()

    def weight(self, rollout: Rollout) -> float:
        """Σ w of the clip over its frames: clips in which more moves count for more."""
        return float(_weights_of(rollout).sum() * len(rollout.target))


class PSNR(Metric):
    """Peak signal-to-noise ratio −10·log₁₀(MSE + 1e-8), at most 80 dB.

    A clip's value comes from the MSE of all its frames, and the summary from the mean MSE of all
    clips, as published: the worst clips weigh most. `psnr_mean` averages decibels instead.
    """

    name = "psnr"
    unit = "dB"
    higher_is_better = True
    rank = 10

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in dB."""
        return decibels(MSE().per_frame(rollout))

    def value(self, rollout: Rollout) -> float:
        """Of the whole clip, from its MSE, in dB."""
        return float(decibels(MSE().value(rollout)))

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """Of many clips, from the mean of their MSE, in dB."""
        errors = 10.0 ** (-np.asarray(values, dtype=np.float64) / 10) - ERROR_FLOOR
        return float(decibels(np.average(errors, weights=weights)))


class MeanPSNR(PSNR):
    """PSNR of each clip, summed up by the mean of the clips' decibels."""

    name = "psnr_mean"
    rank = 100

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """The mean, in dB."""
        return Metric.summarise(self, values, weights)


def videos(rollout: Rollout) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Prediction and target, each `[T, 3, H, W]` in double precision.

    Raises:
        ShapeError: they differ in shape, or hold no frame.
    """
    rollout.check_shapes()
    clips = (clip.detach().cpu().double().numpy() for clip in (rollout.prediction, rollout.target))
    prediction, target = clips
    return prediction, target


def motion_weights(target: Clip) -> NDArray[np.float64]:
    """The weights `[H, W]` of M-MSE from the true clip `[T, 3, H, W]`."""
    video = target.detach().cpu().float()
    first, least, most = video[0], video.amin(0), video.amax(0)
    moved = torch.maximum(most - first, first - least).amax(0)  # the largest |video − first|
    return MOTION_FLOOR + moved.double().numpy()


def _weights_of(rollout: Rollout) -> NDArray[np.float64]:
    """`motion_weights` of a clip's target, worked out once."""
    return rollout.once(motion_weights, lambda: motion_weights(rollout.target))


def decibels(error: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """PSNR of a mean squared error of values in [0, 1]."""
    return -10 * np.log10(np.asarray(error) + ERROR_FLOOR)
