"""The `Tracks` of a clip: where a model sees things, and where it expects them."""

from __future__ import annotations

import torch

from acwm_core.evaluation.clips import draw_seeds
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.results import Tracks
from acwm_core.model.world_model import WorldModel

LEAST_SHARE = 0.08
"""Keypoints for which the picture cares less are left out: what they do means nothing."""


def tracks_of(world_model: object, prediction: Prediction) -> Tracks | None:
    """The tracks of a clip that a model predicted; None if it sees no keypoints."""
    if not isinstance(world_model, WorldModel) or not world_model.keypoint_names:
        return None
    clip, stride = prediction.clip, world_model.codec.temporal_stride
    whole = (len(prediction.target) - 1) // stride * stride + 1
    if whole <= clip.given:
        return None
    true = prediction.target[None, :whole].to(world_model.device)
    actions = torch.as_tensor(prediction.actions[None, :whole], device=world_model.device)
    with torch.autocast(true.device.type, enabled=False):
        seen = world_model.read_keypoints(true)
        later = world_model.predict_keypoints(
            true[:, : clip.given], actions, seeds=draw_seeds(clip.seed, 1)
        )
    shares = seen.shares.cpu().numpy()
    kept = [number for number, share in enumerate(shares) if share >= LEAST_SHARE]
    given = seen.values[0, : seen.values.shape[1] - later.values.shape[1]]

    def places(values: torch.Tensor) -> list[list[list[float | None]]]:
        rows = (values[:, kept, :2].cpu().numpy() + 1) / 2
        return [[[_rounded(number) for number in place] for place in row] for row in rows]

    return Tracks(
        names=[world_model.keypoint_names[number] for number in kept],
        shares=[round(float(shares[number]), 3) for number in kept],
        every=stride,
        seen=places(seen.values[0]),
        predicted=places(torch.cat([given, later.values[0]])),
    )


def _rounded(number: float) -> float | None:
    return round(float(number), 4) if number == number else None
