"""The training loss of an estimator's network."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from acwm_estimators.layout import Layout
from acwm_estimators.network import BLUR, HEIGHT, NetworkOutput, cells

PIXELS = 128
"""Largest number of rows at which masks are compared in full."""

MARGIN = 0.2
"""Distance beyond the frame's edge, in frame heights, from which points are ignored."""


def losses(
    output: NetworkOutput,
    classes: Tensor,
    targets: Mapping[str, Tensor],
    layout: Layout,
    rng: np.random.Generator,
) -> dict[str, Tensor]:
    """The parts of the loss by name.

    Args:
        output: output of the network.
        classes: class of every pixel, `[N, H, W]`.
        targets: see `acwm_estimators.targets.targets_of`.
        layout: layout of the network.
        rng: chooses pixels in large frames.
    """
    aspect = classes.shape[2] / classes.shape[1]
    parts = {"masks": 6 * mask_loss(output.logits, classes, rng)}
    for points in layout.points:
        there, wanted = targets[f"there:{points.field}"], targets[f"points:{points.field}"]
        there = there * _inside(wanted, aspect)
        seen, heat = output.points[points.field], output.heat[points.field]
        if points.plane is not None:  # the plane determines the depth
            wanted, seen = wanted[..., :2], seen[..., :2]
        parts[f"heat {points.field}"] = 0.1 * heat_loss(heat, wanted, there, aspect)
        off = (seen - wanted).abs() * there[..., None] / there.sum().clamp(min=1)
        parts[points.field] = off[..., :2].sum() * HEIGHT / 8 + 8 * off[..., 2:].sum()
    for index, local in enumerate(layout.locals):
        there = targets[f"there:{local.under}"][:, : local.count, None]
        code = output.locals[index]
        if local.encoding in ("angle", "yaw"):  # only the direction matters
            code = code / (code.square().sum(-1, keepdim=True) + 1e-4).sqrt()
        off = (code - targets[f"local:{index}"]).abs() * there
        spread = off.new_tensor(1.0) if local.width > 1 else targets[f"local:{index}"].std() + 1e-3
        parts[f"{local.field} as {local.encoding}"] = off.sum() / there.sum().clamp(min=1) / spread
    if layout.totals:
        off, whole = output.totals - targets["totals"], targets["totals"].sum(-1).clamp(min=1e-6)
        parts["totals"] = 3 * (off.abs().sum(-1) / whole).mean()
        parts["amount"] = 3 * (off.sum(-1).abs() / whole).mean()  # the sum is what is conserved
    if output.surface is not None:
        parts["surface"] = 100 * (output.surface - targets["surface"]).abs().mean()
    return parts


def mask_loss(logits: Tensor, classes: Tensor, rng: np.random.Generator) -> Tensor:
    """Cross-entropy of pixels, and 1 − Dice of each class present (Milletari et al. 2016).

    In large frames, every second row and column is compared, with a random offset.
    """
    step = 1 + (classes.shape[1] > PIXELS)
    logits = functional.interpolate(logits.float(), tuple(classes.shape[1:]), mode="bilinear")
    y, x = rng.integers(step, size=2)
    logits, classes = logits[:, :, y::step, x::step], classes[:, y::step, x::step]
    entropy = functional.cross_entropy(logits, classes)
    found = logits.softmax(1)
    true = functional.one_hot(classes, logits.shape[1]).movedim(-1, 1).to(found)
    both, each = (found * true).sum((0, 2, 3)), (found + true).sum((0, 2, 3))
    there = true.sum((0, 2, 3)) > 0
    return 2 * entropy + (1 - 2 * both[there] / each[there]).mean()


def heat_loss(heat: Tensor, wanted: Tensor, there: Tensor, aspect: float) -> Tensor:
    """Cross-entropy of heat maps against small blurred discs at the points."""
    height, width = heat.shape[2:]
    places = cells(height, width, aspect)
    limits = torch.tensor([aspect / 2, 0.5]) - 0.5 / height
    where = torch.maximum(torch.minimum(wanted[..., :2], limits), -limits)
    distance = (places - where[..., None, None]).square().sum(2)
    disc = (-distance * height**2 / (2 * BLUR**2)).flatten(2).softmax(-1)
    entropy = -(disc * heat.flatten(2)).sum(-1)
    return (entropy * there).sum() / there.sum().clamp(min=1)


def _inside(wanted: Tensor, aspect: float) -> Tensor:
    limits = torch.tensor([aspect / 2, 0.5]) + MARGIN
    return (wanted[..., :2].abs() < limits).all(-1).float()
