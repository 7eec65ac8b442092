"""Metrics of pixels: squared errors as in ACWM-Phys (arXiv 2605.08567), and SSIM."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.errors import ShapeError
from acwm_core.evaluation.metric import Metric, Numbers, Prediction
from acwm_core.model.shapes import Clip

MOTION_FLOOR = 0.01
"""Weight in M-MSE of a pixel that never changes."""

ERROR_FLOOR = 1e-8
"""Added to the MSE before the logarithm of PSNR, as published: a perfect clip has 80 dB."""


WINDOW = 7
"""Side of SSIM's uniform window, in pixels, as in the published evaluation."""

PIXELS = WINDOW * WINDOW

LUMINANCE, CONTRAST = 0.01**2, 0.03**2
"""SSIM's constants C₁ and C₂, which keep the quotients finite, for values in [0, 1]."""


class MSE(Metric):
    """Mean squared error over pixels and channels, of values in [0, 1]."""

    name = "mse"
    bounds = (0.0, math.inf)
    title = "MSE"
    group = "Pixels"
    reads = "pixels"
    factor = 1000.0

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The error of each frame, `[T]`."""
        return _squared_error(prediction).mean((1, 2), dtype=np.float64)


class MaskedMSE(Metric):
    """M-MSE: squared error weighted by how much each pixel moves in the true video.

    w = 0.01 + max over frames and channels of |target − target's first frame|, one weight per
    pixel of the clip; the error is Σ w·(prediction − target)² / Σ w. The clip's value is the mean
    over its frames, since they share the weights.
    """

    name = "m_mse"
    bounds = (0.0, math.inf)
    title = "M-MSE"
    group = "Pixels"
    reads = "pixels"
    factor = 1000.0

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The weighted error of each frame, `[T]`."""
        errors, weights = _squared_error(prediction), _weights_of(prediction)
        return np.einsum("thw,hw->t", errors, weights, dtype=np.float64) / weights.sum()

    def weight(self, prediction: Prediction) -> float:
        """Σ w over all frames of the clip: clips with more motion weigh more."""
        return float(_weights_of(prediction).sum() * len(prediction.target))


class PSNR(Metric):
    """Peak signal-to-noise ratio −10·log₁₀(MSE + 1e-8), at most 80 dB.

    As published, a clip's value comes from the MSE of all its frames, and the summary from the mean
    MSE of all clips, so the worst clips weigh most. `psnr_mean` averages decibels instead.
    """

    name = "psnr"
    unit = "dB"
    higher_is_better = True
    title = "PSNR"
    group = "Pixels"
    reads = "pixels"
    rank = 10

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """PSNR of each frame, `[T]`, in dB."""
        return decibels(MSE().per_frame(prediction))

    def value(self, prediction: Prediction) -> float:
        """PSNR of the whole clip, from its MSE, in dB."""
        return float(decibels(MSE().value(prediction)))

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """PSNR of many clips, from their mean MSE, in dB."""
        errors = 10.0 ** (-np.asarray(values, dtype=np.float64) / 10) - ERROR_FLOOR
        return float(decibels(np.average(errors, weights=weights)))


class MeanPSNR(PSNR):
    """PSNR of each clip, summarised as the mean of the clips' decibels."""

    name = "psnr_mean"
    title = "PSNR mean"
    rank = 100

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """The mean of the clips, in dB."""
        return Metric.summarise(self, values, weights)


class SSIM(Metric):
    """Structural similarity of each frame (Wang et al. 2004).

    It uses a uniform 7×7 window and takes the mean over pixels and channels. The values equal those
    of scikit-image's `structural_similarity` to the last digits, in half the time: it computes four
    windowed sums instead of five, for all channels at once.
    """

    name = "ssim"
    bounds = (-1.0, 1.0)
    higher_is_better = True
    title = "SSIM"
    group = "Pixels"
    reads = "pixels"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """SSIM of each frame, `[T]`, in [-1, 1].

        Raises:
            ShapeError: the frames are smaller than the window.
        """
        prediction.check_shapes()
        pair = prediction.video, prediction.target
        made, true = (clip.detach().cpu().numpy() for clip in pair)
        height, width = true.shape[2:]
        if min(height, width) < WINDOW:
            raise ShapeError(f"SSIM needs frames of at least 7×7 pixels, not {height}×{width}")
        return np.array([similarity(*pair) for pair in zip(true, made, strict=True)])


def videos(prediction: Prediction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Prediction and target, each `[T, 3, H, W]` in double precision."""
    prediction.check_shapes()
    pair = prediction.video, prediction.target
    made, true = (clip.detach().cpu().double().numpy() for clip in pair)
    return made, true


def motion_weights(target: Clip) -> NDArray[np.float64]:
    """The weights `[H, W]` of M-MSE for a true clip `[T, 3, H, W]`."""
    video = target.detach().cpu().float()
    first, least, most = video[0], video.amin(0), video.amax(0)
    moved = torch.maximum(most - first, first - least).amax(0)  # the largest |video − first|
    return MOTION_FLOOR + moved.double().numpy()


def _squared_error(prediction: Prediction) -> NDArray[np.float32]:
    """Squared error of each pixel, mean over channels, `[T, H, W]`; computed once."""

    def work_out() -> NDArray[np.float32]:
        prediction.check_shapes()
        pair = prediction.video, prediction.target
        made, true = (clip.detach().cpu().float() for clip in pair)
        return (made - true).square_().mean(1).numpy()

    return prediction.once(_squared_error, work_out)


def _weights_of(prediction: Prediction) -> NDArray[np.float64]:
    """`motion_weights` of a clip's target, computed once per prediction."""
    return prediction.once(motion_weights, lambda: motion_weights(prediction.target))


def decibels(error: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """PSNR for a mean squared error of values in [0, 1]."""
    return -10 * np.log10(np.asarray(error) + ERROR_FLOOR)


def similarity(one: NDArray[Any], other: NDArray[Any]) -> float:
    """SSIM of two images `[3, H, W]` in [0, 1], by equation 13 of Wang et al. (2004)."""
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
    """Sums over all windows inside `[…, H, W]`: `[…, H − 6, W − 6]`.

    Adds 7 = 4 + 2 + 1 neighbours, first down, then across.
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
