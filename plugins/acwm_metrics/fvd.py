"""FVD, the Fréchet video distance of Unterthiner et al. 2018 (arXiv 1812.01717)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.shards import file_sha256
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import DataError
from acwm_core.evaluation.metric import Prediction, SetMetric
from acwm_core.model.shapes import Clip

SIDE = 224
"""Frames are resized to squares of this side, on which the network was trained."""

MIN_FRAMES = 10
"""Shortest clip for the network, which halves time three times and averages over the rest."""


class FVD(SetMetric):
    """Fréchet distance between Gaussians fitted to I3D features of predicted and true clips.

    It is biased upwards for few clips (fewer clips than its 400 features cannot span all
    directions), so only compare values from the same number of clips. The last frame of a clip that
    is shorter than 10 frames is repeated.

    Args:
        detector: the TorchScript file ``i3d_torchscript.pt`` of StyleGAN-V. A TorchScript file is
            a program: only use a file that you trust.
    """

    name = "fvd"
    title = "FVD"
    group = "Perception"
    reads = "pixels"

    def __init__(self, *, detector: str | None = None) -> None:
        self.file = Path(detector) if detector else None
        self._detector = _load(self.file) if self.file else None

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """It is unavailable without weights."""
        if self._detector is None:
            return (
                f"it needs weights: give evaluation.metric_options.{self.name}.detector="
                "i3d_torchscript.pt"
            )
        return None

    def provenance(self) -> Mapping[str, str]:
        """The hash of the detector file."""
        return {"detector": file_sha256(self.file)} if self.file else {}

    def features(self, prediction: Prediction) -> NDArray[np.float32]:
        """Features of prediction and target, `[2, D]`."""
        prediction.check_shapes()
        pair = (prediction.video, prediction.target)
        return np.stack([self._features(clip)[0].float().numpy() for clip in pair])

    def distance(self, features: NDArray[np.float32]) -> float:
        """The Fréchet distance of the two sets in `[N, 2, D]`; NaN for fewer than two clips."""
        if len(features) < 2:
            return float("nan")
        made, true = features.astype(np.float64).swapaxes(0, 1)
        return frechet_distance(made, true)

    def _features(self, clip: Clip) -> Tensor:
        assert self._detector is not None
        frames = clip.detach().cpu().float()
        missing = MIN_FRAMES - len(frames)
        if missing > 0:
            frames = torch.cat([frames, frames[-1:].expand(missing, -1, -1, -1)])
        resized = F.interpolate(frames, (SIDE, SIDE), mode="bilinear", align_corners=False)
        video = (resized * 2 - 1).movedim(0, 1)[None]
        with torch.inference_mode():
            return self._detector(video, rescale=False, resize=False, return_features=True)


def frechet_distance(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """The squared Fréchet distance of Gaussians fitted to two sets of vectors `[N, D]`.

    |μ₁ − μ₂|² + tr(Σ₁ + Σ₂ − 2 (Σ₁^½ Σ₂ Σ₁^½)^½). This is the formula of Dowson and Landau 1982,
    written with symmetric matrices only, so that its roots are real even for singular covariances.
    """
    means = one.mean(0) - other.mean(0)
    first, second = (np.atleast_2d(np.cov(each, rowvar=False)) for each in (one, other))
    values, vectors = np.linalg.eigh(first)
    root = vectors * np.sqrt(values.clip(min=0)) @ vectors.T
    common = np.sqrt(np.linalg.eigvalsh(root @ second @ root).clip(min=0)).sum()
    distance = means @ means + np.trace(first) + np.trace(second) - 2 * common
    return float(max(distance, 0.0))


def _load(path: Path) -> Any:
    if not path.is_file():
        raise DataError(f"{path} is missing")
    try:
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            return torch.jit.load(path, map_location="cpu").eval()  # it only exists as TorchScript
    except RuntimeError as error:
        raise DataError(f"{path} is not a TorchScript file such as i3d_torchscript.pt") from error
