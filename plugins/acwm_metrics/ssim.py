"""Structural similarity (Wang et al. 2004)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from acwm_core.errors import ShapeError
from acwm_core.metric import Metric, Rollout
from acwm_metrics.pixel import videos

WINDOW = 7
"""Side of the uniform window, in pixels, as in the published evaluation."""


class SSIM(Metric):
    """Structural similarity of each frame: uniform 7×7 window, mean over pixels and channels."""

    name = "ssim"
    higher_is_better = True

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in [-1, 1].

        Raises:
            ShapeError: frames smaller than the window.
        """
        prediction, target = videos(rollout)
        if min(target.shape[2:]) < WINDOW:
            height, width = target.shape[2:]
            raise ShapeError(f"SSIM needs frames of at least 7×7 pixels, not {height}×{width}")
        return np.array(
            [
                structural_similarity(true, seen, win_size=WINDOW, data_range=1.0, channel_axis=0)
                for true, seen in zip(target, prediction, strict=True)
            ]
        )
