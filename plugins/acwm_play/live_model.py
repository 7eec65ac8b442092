"""The model of a session: predicts from a simulator frame on, one latent frame at a time."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.pictures import to_pixels
from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import RecipeError, ShapeError, noting
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.tracks import LEAST_SHARE
from acwm_core.model.stream import Stream
from acwm_core.model.world_model import WorldModel

Frames = NDArray[np.uint8]

SAMPLES = 3
"""Futures drawn from a model that draws: the one shown, and others to compare it with."""

SHARE = 0.5
"""Share of real time that prediction with all samples may take."""


class LiveModel:
    """A stream of a world model that can be restarted from the simulator's frames.

    Args:
        world_model: the world model; shared by all sessions, which do not modify it.
        card: card of the environment that is played.
        steps: sampling steps; the model's own number by default.

    Attributes:
        stride: video frames per latent frame, which is the number of actions per step.
        given: number of frames that it starts from.
        samples: whether the model draws.
        draw: number of the draw that is shown from the next restart on.
        spread: root mean square, over the last predicted frame, of the standard deviation of
            `SAMPLES` draws, as a share of full scale; None if the model draws none or drawing is
            too slow.
        doubt: the same by pixel, the largest over channels, `[1, H, W, 3]` uint8 in grey; or None.

    Raises:
        ShapeError: the model was trained on other actions.
        RecipeError: the model cannot be streamed.
    """

    def __init__(self, world_model: WorldModel, card: EnvironmentCard, steps: int | None) -> None:
        low, high = world_model.action_low.tolist(), world_model.action_high.tolist()
        action = card.action
        if len(low) != action.size or not np.allclose([low, high], [action.low, action.high]):
            raise ShapeError(
                f"the model was trained on other actions than those of {card.name}: choose the "
                "world of its data, or a variant of that, with --env"
            )
        self._world_model = world_model
        self._steps = steps
        self.stride = world_model.codec.temporal_stride
        self.given = world_model.context_frames
        self.samples, self.draw = world_model.samples, 0
        self._patience = SHARE * self.stride / card.fps
        self._others: Stream | None = None
        self.spread: float | None = None
        self.doubt: Frames | None = None
        blank = np.zeros((self.given, *card.frame_size, 3), np.uint8)
        still = [np.array(low, np.float32)] * (self.given - 1)
        try:
            self.restart(blank, still)
        except RecipeError as error:
            raise RecipeError(f"this model cannot be played: {error}") from error

    def restart(self, frames: Frames, actions: Sequence[NDArray[np.float32]]) -> Frames:
        """Restart from frames `[K, H, W, 3]` and the K − 1 raw actions between them.

        Returns:
            The last frame as the model sees it, `[H, W, 3]` uint8.
        """
        video = as_clip(frames)[None]
        between = torch.from_numpy(np.stack(actions)[None]) if len(actions) else None
        with noting("when the model begins", *self._world_model.children()):
            first, *seeds = range(SAMPLES * self.draw, SAMPLES * (self.draw + 1))
            self._stream = self._world_model.stream(
                video, between, steps=self._steps, seeds=[first]
            )
            if self.samples:
                self._others = self._world_model.stream(
                    video.expand(SAMPLES - 1, -1, -1, -1, -1),
                    None if between is None else between.expand(SAMPLES - 1, -1, -1),
                    steps=self._steps,
                    seeds=seeds,
                )
        self.spread = self.doubt = None
        return to_pixels(self._stream.given[0, -1:])[0]

    @property
    def keypoints(self) -> list[tuple[int, float, float]]:
        """Number and place, right and down from 0 to 1, of the things that can be moved."""
        keypoints = self._stream.keypoints()
        if keypoints is None:
            return []
        places, shares = (keypoints.values[0, 0, :, :2] + 1) / 2, keypoints.shares
        return [
            (number, round(x, 4), round(y, 4))
            for number, ((x, y), share) in enumerate(zip(places.tolist(), shares, strict=True))
            if share >= LEAST_SHARE and math.isfinite(x + y)
        ]

    def move(self, number: int, place: Sequence[float]) -> None:
        """Move one of `keypoints` to a place in the picture, from 0 to 1, in all samples.

        Raises:
            RecipeError: there is no such thing.
        """
        inside = [2 * min(max(part, 0.0), 1.0) - 1 for part in place]
        for stream in filter(None, (self._stream, self._others)):
            stream.move_keypoint(number, inside)

    def step(self, actions: Sequence[NDArray[np.float32]]) -> Frames:
        """Predict the frames `[stride, H, W, 3]` uint8 for `stride` raw actions."""
        rows, start = torch.from_numpy(np.stack(actions)[None]), time.monotonic()
        with noting("while the model predicts", *self._world_model.children()):
            video = self._stream.step(rows)
            self.spread = self.doubt = None
            if self._others is not None:
                others = self._others.step(rows.expand(SAMPLES - 1, -1, -1))
                self.spread, self.doubt = _spread(torch.cat([video, others])[:, -1])
        if time.monotonic() - start > self._patience:
            self._others = None  # until the next restart
        return to_pixels(video[0])


def _spread(frames: torch.Tensor) -> tuple[float, Frames]:
    variance = frames.var(0)
    grey = variance.amax(0).sqrt().expand(1, 3, -1, -1)
    return float(variance.mean().sqrt()), to_pixels(grey)
