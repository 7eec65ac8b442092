"""`WorldModel`: a codec, a dynamics model and a conditioner that predict video together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from acwm_core.codec import Codec
from acwm_core.conditioner import Conditioner
from acwm_core.dynamics import DynamicsModel, hidden_matrices
from acwm_core.errors import ActionError, ShapeError
from acwm_core.shapes import Actions, Frame, Latent, Video
from acwm_core.streaming import Stream, continued

CLIP_FRAMES = 37
"""Frames of a clip: 10 latent frames at a temporal stride of 4 (the published window)."""


class WorldModel(nn.Module):
    """Given a first frame and actions, predicts the video. Plain PyTorch, no trainer.

    Args:
        codec: frozen here; it stays in evaluation mode whatever `train()` says.
        model: predicts latents.
        conditioner: built to fit the model.
        action_low: lower action bounds in raw units, from the environment card.
        action_high: upper bounds; actions are normalised to [-1, 1] by both.
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        codec: Codec,
        model: DynamicsModel,
        conditioner: Conditioner,
        action_low: Sequence[float],
        action_high: Sequence[float],
    ) -> None:
        super().__init__()
        self.codec = codec.requires_grad_(False).eval()
        self.model = model
        self.conditioner = conditioner
        self.register_buffer("action_low", torch.tensor(action_low), persistent=False)
        self.register_buffer("action_high", torch.tensor(action_high), persistent=False)

    def train(self, mode: bool = True) -> WorldModel:
        """Like `nn.Module.train`, but the frozen codec stays in evaluation mode."""
        super().train(mode)
        self.codec.eval()
        return self

    def matrices(self) -> list[nn.Parameter]:
        """The hidden weight matrices of model and conditioner, for optimisers such as Muon."""
        return [*self.model.matrices(), *hidden_matrices(self.conditioner)]

    @torch.no_grad()
    def encode(self, video: Video) -> Latent:
        """Latents of a video through the frozen codec."""
        return self.codec.encode(video)

    def loss(
        self, latents: Latent, actions: Actions, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Training loss of a batch of clips, a scalar.

        Args:
            latents: clean latents `[B, L, C, h, w]`.
            actions: raw actions of the clip's T frames, `[B, T, A]`.
            generators: a CPU generator per clip, of its noise and noise levels.
        """
        conditioning = self.conditioner(self._prepare(actions, latents.shape[1]))
        return self.model.loss(latents, conditioning, generators)

    @torch.no_grad()
    def rollout(
        self,
        first_frame: Frame,
        actions: Actions,
        *,
        steps: int | None = None,
        window: int = CLIP_FRAMES,
        seeds: Sequence[int] | None = None,
    ) -> Video:
        """Predict the video that follows `first_frame` under `actions`.

        Videos longer than `window` are predicted window by window, each starting from the last
        frame predicted.

        Args:
            first_frame: `[B, 3, H, W]` in [0, 1].
            actions: raw actions `[B, T, A]`; row i takes frame i to i + 1, the last row is unused.
            steps: network evaluations; the model's own number by default.
            window: frames predicted at once, at least 2.
            seeds: one per batch element, so that an element's noise does not depend on its
                neighbours; 0, 1, … by default.

        Returns:
            `[B, T, 3, H, W]`, its first frame the codec's reconstruction of `first_frame`.

        Raises:
            ShapeError: batch sizes that differ, a window below 2, or frames not as `check_frame`
                wants them.
            ActionError: actions of the wrong size, not finite, or out of bounds.
        """
        check_frame(first_frame)
        self.checked(actions[:, :-1])
        windows = self.rollout_windows(
            first_frame, actions, steps=steps, window=window, seeds=seeds
        )
        return torch.cat(list(windows), dim=1)

    @torch.no_grad()
    def rollout_windows(
        self,
        first_frame: Frame,
        actions: Actions,
        *,
        steps: int | None = None,
        window: int = CLIP_FRAMES,
        seeds: Sequence[int] | None = None,
    ) -> Iterator[Video]:
        """What `rollout` returns, one window after the other: no more than one is held.

        It takes actions as they are, also such as were recorded out of their bounds.

        Yields:
            Up to `window` frames, then up to `window` − 1 that follow, and so on.
        """
        if window < 2:
            raise ShapeError(f"a rollout window of {window} frames predicts nothing")
        generators = _generators(first_frame, len(actions), seeds)
        frame = first_frame
        for start in range(0, max(actions.shape[1] - 1, 1), window - 1):
            chunk = self._predict(frame, actions[:, start : start + window], steps, generators)
            frame = chunk[:, -1]
            yield chunk if start == 0 else chunk[:, 1:]

    def stream(
        self,
        first_frame: Frame,
        *,
        steps: int | None = None,
        context: int | None = None,
        seeds: Sequence[int] | None = None,
    ) -> Stream:
        """A video that continues from `first_frame` as actions come in, of any length.

        Args:
            first_frame: `[B, 3, H, W]` in [0, 1].
            steps: network evaluations; the model's own number by default.
            context: latent frames that a frame sees, its own included; by default those of a
                clip of `CLIP_FRAMES`. A model knows no longer past than that of its training.
            seeds: one per batch element; 0, 1, … by default.

        Raises:
            RecipeError: the components cannot be streamed; a denoiser must be causal and trained
                with `flow.objective=diffusion_forcing`.
            ShapeError: not one seed per first frame, or a frame not as `check_frame` wants it.
        """
        check_frame(first_frame)
        return Stream(
            self,
            first_frame,
            steps=steps,
            context=self.codec.latent_frames(CLIP_FRAMES) if context is None else context,
            generators=_generators(first_frame, len(first_frame), seeds),
        )

    def _predict(
        self,
        first_frame: Frame,
        actions: Actions,
        steps: int | None,
        generators: Sequence[torch.Generator],
    ) -> Video:
        """One window: as many frames as there are action rows."""
        frames = actions.shape[1]
        first = self.codec.encode(first_frame[:, None])
        length = self.codec.latent_frames(frames)
        conditioning = self.conditioner(self._prepare(actions, length))
        latents = self.model.predict(first, conditioning, length, generators, steps)
        return self.codec.decode(latents, frames=frames)

    def checked(self, actions: Actions) -> Actions:
        """The raw actions `[B, T, A]` that a user gives, if a model can take them.

        Raises:
            ShapeError: not three dimensions.
            ActionError: wrong action size, not finite, or out of bounds.
        """
        if actions.ndim != 3:
            raise ShapeError(f"actions are [B, T, A], not {list(actions.shape)}")
        self.normalise(actions)
        if not actions.isfinite().all():
            raise ActionError("the actions are not finite")
        low, high = self.action_low, self.action_high
        slack = 1e-6 * (high - low)  # float32 rounding of a bound is no violation
        outside = ((actions < low - slack) | (actions > high + slack)).flatten(0, 1).any(0)
        if outside.any():
            size = int(outside.int().argmax())
            raise ActionError(
                f"dimension {size} of the actions is out of its bounds "
                f"[{low[size]:g}, {high[size]:g}]: clip it, with "
                "actions.clamp(world_model.action_low, world_model.action_high)"
            )
        return actions

    def normalise(self, actions: Actions) -> Actions:
        """Raw actions `[B, T, A]` to [-1, 1].

        Raises:
            ActionError: wrong action size.
        """
        if actions.shape[2] != len(self.action_low):
            raise ActionError(
                f"the model was built for {len(self.action_low)} action dimensions, "
                f"not {actions.shape[2]}"
            )
        return 2 * (actions - self.action_low) / (self.action_high - self.action_low) - 1

    def _prepare(self, actions: Actions, latent_frames: int) -> Actions:
        """Normalise, fill the last latent frame, and zero the last row, which leads nowhere.

        It is filled with its last action: a row of zeros would be an action too, and one that asks
        for another place where actions are targets.
        """
        missing = self.codec.video_frames(latent_frames) - actions.shape[1]
        rows = continued(actions[:, :-1], missing)
        return self.normalise(nn.functional.pad(rows, (0, 0, 0, 1)))


def check_frame(frame: Frame) -> None:
    """Refuse a first frame that is not `[B, 3, H, W]`, float and in [0, 1].

    Raises:
        ShapeError: says how to convert it.
    """
    if frame.ndim != 4 or frame.shape[1] != 3:
        raise ShapeError(f"a first frame is [B, 3, H, W], not {list(frame.shape)}")
    if not frame.is_floating_point():
        raise ShapeError(f"a first frame is float in [0, 1], not {frame.dtype}: take frame / 255")
    low, high = (float(value) for value in frame.aminmax())
    if not (low >= -1e-3 and high <= 1 + 1e-3):  # so NaN is refused, too
        raise ShapeError(
            f"a first frame is in [0, 1], not in [{low:g}, {high:g}]: divide one of 0 to 255 by "
            "255, and clamp what resizing made"
        )


def _generators(
    first_frame: Frame, batch: int, seeds: Sequence[int] | None
) -> list[torch.Generator]:
    """Of the noise of each batch element."""
    chosen = range(batch) if seeds is None else seeds
    if not len(first_frame) == batch == len(chosen):
        raise ShapeError(
            f"{len(first_frame)} first frames for {batch} action sequences and {len(chosen)} seeds"
        )
    return [torch.Generator().manual_seed(seed) for seed in chosen]
