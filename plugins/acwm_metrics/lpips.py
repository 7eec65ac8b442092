"""LPIPS, the perceptual distance of Zhang et al. 2018 (arXiv 1801.03924)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.shards import file_sha256
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import DataError
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_metrics.networks import read_tensors

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Shift and scale of pixels in [-1, 1], per channel."""

EPSILON = 1e-10
"""Added to the length of a feature vector before dividing by it."""

MIN_SIDE = 32
"""Side of the smallest frames, in pixels, that all layers of both networks can process."""

CHUNK = 32
"""Frames that go through the network at once."""


@dataclass(frozen=True)
class FeatureLayer:
    """A convolution followed by ReLU.

    Attributes:
        index: index of the convolution in torchvision's ``features``.
        stride: stride of the convolution.
        padding: padding of the convolution.
        pool: size of the max pooling before it, with stride 2; 0 for none.
        compared: whether its output is compared.
    """

    index: int
    stride: int = 1
    padding: int = 1
    pool: int = 0
    compared: bool = False


NETWORKS = {
    "alex": (
        FeatureLayer(0, stride=4, padding=2, compared=True),
        FeatureLayer(3, padding=2, pool=3, compared=True),
        FeatureLayer(6, pool=3, compared=True),
        FeatureLayer(8, compared=True),
        FeatureLayer(10, compared=True),
    ),
    "vgg": (
        FeatureLayer(0),
        FeatureLayer(2, compared=True),
        FeatureLayer(5, pool=2),
        FeatureLayer(7, compared=True),
        FeatureLayer(10, pool=2),
        FeatureLayer(12),
        FeatureLayer(14, compared=True),
        FeatureLayer(17, pool=2),
        FeatureLayer(19),
        FeatureLayer(21, compared=True),
        FeatureLayer(24, pool=2),
        FeatureLayer(26),
        FeatureLayer(28, compared=True),
    ),
}
"""AlexNet and VGG-16, with the layer indices of torchvision."""

FILES = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}
"""Names of torchvision's files with ImageNet weights."""


class LPIPS(Metric):
    """Learned perceptual image patch similarity of each frame, version 0.1.

    Features of AlexNet or VGG-16 are normalised to length 1 per pixel. Their squared differences
    are weighted per channel by learned heads, averaged over pixels, and summed over five layers.

    Args:
        network: ``alex`` or ``vgg``.
        backbone: file with torchvision's ImageNet weights of the network, ``.pth`` or
            ``.safetensors``.
        heads: file with channel weights; by default those of LPIPS 0.1, which come with
            torchmetrics.
    """

    name = "lpips"
    bounds = (0.0, math.inf)
    title = "LPIPS"
    group = "Perception"
    reads = "pixels"

    def __init__(
        self,
        *,
        network: Literal["alex", "vgg"] = "alex",
        backbone: str | None = None,
        heads: str | None = None,
    ) -> None:
        self.network = network
        self.backbone = Path(backbone) if backbone else None
        self.heads = Path(heads) if heads else bundled_heads(network)
        self._layers: list[tuple[Tensor, Tensor]] = []
        self._heads: list[Tensor] = []
        if self.backbone:
            self._layers = _convolutions(self.backbone, NETWORKS[network])
            compared = [
                weight.shape[0]
                for layer, (weight, _) in zip(NETWORKS[network], self._layers, strict=True)
                if layer.compared
            ]
            self._heads = _linear(self.heads, compared)

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """It is unavailable without weights, or for frames that are too small."""
        if not self._heads:
            return (
                f"it needs weights: give evaluation.metric_options.{self.name}.backbone="
                f"{FILES[self.network]} (torchvision's)"
            )
        if min(card.frame_size) < MIN_SIDE:
            height, width = card.frame_size
            return f"its network needs frames of at least 32×32 pixels, not {height}×{width}"
        return None

    def provenance(self) -> Mapping[str, str]:
        """The name of the network and the hashes of its files."""
        if self.backbone is None:
            return {"network": self.network}
        hashes = {"backbone": file_sha256(self.backbone), "heads": file_sha256(self.heads)}
        return {"network": self.network, **hashes}

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The distance in each frame, `[T]`; 0 for equal frames."""
        prediction.check_shapes()
        clips = (clip.detach().cpu().float() for clip in (prediction.video, prediction.target))
        chunks = zip(*(clip.split(CHUNK) for clip in clips), strict=True)
        with torch.inference_mode():
            return np.concatenate([self._distances(*pair).double().numpy() for pair in chunks])

    def _distances(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Distances `[N]` of frames `[N, 3, H, W]`."""
        layers = zip(self._features(prediction), self._features(target), self._heads, strict=True)
        return torch.stack(
            [((a - b) ** 2 * head).sum(1).mean((1, 2)) for a, b, head in layers]
        ).sum(0)

    def _features(self, frames: Tensor) -> list[Tensor]:
        """Outputs of the compared layers, normalised to length 1 in each pixel."""
        shift, scale = (torch.tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        hidden = (frames * 2 - 1 - shift) / scale
        found: list[Tensor] = []
        for layer, (weight, bias) in zip(NETWORKS[self.network], self._layers, strict=True):
            if layer.pool:
                hidden = F.max_pool2d(hidden, layer.pool, 2)
            hidden = F.conv2d(hidden, weight, bias, layer.stride, layer.padding).relu()
            if layer.compared:
                length = hidden.square().sum(1, keepdim=True).sqrt()
                found.append(hidden / (length + EPSILON))
        return found


def bundled_heads(network: str) -> Path:
    """The file with the heads of LPIPS 0.1 in torchmetrics."""
    return Path(str(files("torchmetrics.functional.image"))) / "lpips_models" / f"{network}.pth"


def _convolutions(path: Path, layers: tuple[FeatureLayer, ...]) -> list[tuple[Tensor, Tensor]]:
    """Weight and bias of each layer; checks that their channels fit together."""
    tensors, found, channels = read_tensors(path), list[tuple[Tensor, Tensor]](), 3
    for layer in layers:
        name = f"features.{layer.index}"
        weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
        if weight is None or bias is None or weight.ndim != 4 or weight.shape[1] != channels:
            raise DataError(f"{path} does not hold weights of this network: {name} does not fit")
        channels = weight.shape[0]
        found.append((weight.float(), bias.float()))
    return found


def _linear(path: Path, channels: list[int]) -> list[Tensor]:
    """The channel weights of each compared layer, `[C, 1, 1]`."""
    tensors, found = read_tensors(path), list[Tensor]()
    for place, count in enumerate(channels):
        name = f"lin{place}.model.1.weight"
        weight = tensors.get(name)
        if weight is None or weight.numel() != count:
            raise DataError(f"{path} does not hold heads of this network: {name} does not fit")
        found.append(weight.float().reshape(count, 1, 1))
    return found
