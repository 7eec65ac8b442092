"""`WorldModel`: a codec, a dynamics model and a conditioner that predict video together."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.batch import Batch
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import DynamicsModel, Keypoints, Predictor, hidden_matrices
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Actions, Frame, Latent, Video, check_pixels, float32_by_default
from acwm_core.model.state_stream import StateStream
from acwm_core.model.stream import Stream, continued

CLIP_FRAMES = 37
"""Frames per clip: 10 latent frames at a temporal stride of 4 (the published window)."""

Mode = Literal["stream", "windows", "whole"]
"""How a rollout proceeds: frame by frame with cached state, clip by clip, or all frames at once."""

DECODED_TOGETHER = 8
"""Number of latent frames that a streamed rollout decodes at once."""


class WorldModel(nn.Module):
    """Predicts video from the first frames and actions. Plain PyTorch, no trainer.

    Args:
        codec: it is frozen here and stays in evaluation mode, also after `train()`.
        model: predicts latents.
        conditioner: built to fit the model.
        objective: how the model learns and predicts.
        action_low: lower action bounds in raw units, from the environment card.
        action_high: upper bounds; both are used to normalise actions to [-1, 1].
        clip_frames: number of frames of a training clip.
        context_frames: number of given first frames of a clip; they must be whole latent frames.
        state_shapes: shapes of the fields of the state that the model learns too, in its order.

    Raises:
        RecipeError: `context_frames` are no whole latent frames, or leave nothing to predict.
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        codec: Codec,
        model: DynamicsModel,
        conditioner: Conditioner,
        objective: Objective[Any],
        action_low: Sequence[float],
        action_high: Sequence[float],
        *,
        clip_frames: int = CLIP_FRAMES,
        context_frames: int = 1,
        state_shapes: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        super().__init__()
        stride = codec.temporal_stride
        if context_frames < 1 or (context_frames - 1) % stride or context_frames >= clip_frames:
            raise RecipeError(
                f"data.context_frames={context_frames} must be 1 plus a multiple of the codec's "
                f"{stride} frames per latent frame, and below data.clip_frames={clip_frames}"
            )
        self.clip_frames, self.context_frames = clip_frames, context_frames
        self.codec = codec.requires_grad_(False).eval()
        self.model, self.conditioner, self.objective = model, conditioner, objective
        self.register_buffer("action_low", torch.tensor(action_low), persistent=False)
        self.register_buffer("action_high", torch.tensor(action_high), persistent=False)
        self.state_shapes = {name: tuple(shape) for name, shape in (state_shapes or {}).items()}

    def train(self, mode: bool = True) -> WorldModel:
        """Like `nn.Module.train`, but the frozen codec stays in evaluation mode."""
        super().train(mode).codec.eval()
        return self

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self.action_low.device

    @property
    def steps(self) -> int | None:
        """Default number of network evaluations per window; None without sampling steps."""
        return self.objective.steps

    @property
    def mode(self) -> Mode:
        """Default mode of rollouts: "stream" if the model was trained for it, else "windows"."""
        streams = self.objective.streams_by_default(self.model)
        if not streams or self.conditioner.history is None:
            return "windows"
        try:
            self.codec.frame_decoder()
        except RecipeError:
            return "windows"
        return "stream"

    @property
    def samples(self) -> bool:
        """Whether seeds matter: it draws one of several futures; see `DynamicsModel.samples`."""
        return self.model.samples

    def matrices(self) -> list[nn.Parameter]:
        """The hidden weight matrices of model and conditioner, for optimisers such as Muon."""
        return [*(self.model.matrices() or []), *hidden_matrices(self.conditioner)]

    @torch.no_grad()
    def encode(self, video: Video) -> Latent:
        """Encode a video to latents with the frozen codec."""
        return self.codec.encode(video)

    def loss(
        self,
        latents: Latent,
        actions: Actions,
        generators: Sequence[torch.Generator] = (),
        states: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Training loss of a batch of clips, a scalar.

        Args:
            latents: clean latents `[B, L, C, h, w]`; L exceeds the number of given latent frames.
            actions: raw actions of the clip's T frames, `[B, T, A]`.
            generators: one CPU generator per clip, for its noise; by default seeded from torch's.
            states: raw states of the clip's T frames to learn from, `[B, T, S]`.
            weights: how much the frame counts that each action leads to, `[B, T]`, 0 or more. A
                latent frame has the mean weight of the actions that lead to it.
        """
        seeds = torch.randint(2**62, (0 if generators else len(latents),))
        generators = generators or [torch.Generator().manual_seed(int(seed)) for seed in seeds]
        conditioning = self.condition(actions, latents.shape[1])
        known = self.codec.latent_frames(self.context_frames)
        weights = None if weights is None else self._of_latent_frames(weights, latents.shape[1])
        batch = Batch(latents, conditioning, generators, states, weights)
        return self.objective.loss(self.model, batch, known)

    def _of_latent_frames(self, weights: Tensor, latent_frames: int) -> Tensor:
        """Weights of actions `[B, T]` as those of the latent frames `[B, L]` that they lead to."""
        steps = weights[:, : self.codec.video_frames(latent_frames) - 1]
        means = steps.reshape(len(steps), latent_frames - 1, -1).mean(2)
        return nn.functional.pad(means, (1, 0), value=1)

    def condition(self, actions: Actions, latent_frames: int) -> Conditioning:
        """The embedded raw actions `[B, T, A]` of clips with `latent_frames` latent frames."""
        rows = self._prepare(actions, latent_frames)
        return self.conditioner.condition(rows, latent_frames, self.model.width)

    @torch.no_grad()
    def predict_states(
        self, given: Frame | Video, actions: Actions, *, seeds: Sequence[int] | None = None
    ) -> dict[str, Tensor]:
        """Predict the fields of the state after the given frames, without drawing a picture.

        Args:
            given: the first frames, as for `rollout_chunks`.
            actions: raw actions `[B, T, A]` of all frames.
            seeds: one per batch element; 0, 1, … by default.

        Returns:
            By name, `[B, T − K, …]` in the units of the card; NaN where the model knows none.

        Raises:
            RecipeError: the model predicts no states.
        """
        if not isinstance(self.model, Predictor) or not self.predicts_states:
            raise RecipeError(f"{type(self.model).__name__} predicts no states")
        video = self._given(given)
        frames = actions.shape[1]
        length = self.codec.latent_frames(frames)
        values = self.model.predict_states(
            self.codec.encode(video),
            self.condition(actions, length),
            length,
            _generators(video, len(actions), seeds),
        )[:, : frames - video.shape[1]]
        return self.named_states(values)

    @float32_by_default()
    def stream_states(
        self,
        given: Frame | Video,
        actions: Actions | None = None,
        *,
        seeds: Sequence[int] | None = None,
    ) -> StateStream:
        """Start to predict the states of many scenes step by step, as actions arrive.

        No picture is drawn, so thousands of scenes may be moved at once.

        Args:
            given: the first frames of each scene, as for `rollout_chunks`.
            actions: raw actions between them, `[B, K − 1, A]`; none for a single frame.
            seeds: one per scene; 0, 1, … by default.

        Raises:
            RecipeError: the model does not carry states.
        """
        able = isinstance(self.model, Predictor) and self.model.implements("carry_states")
        if not able or not self.state_shapes:
            raise RecipeError(f"{type(self.model).__name__} carries no states from frame to frame")
        video = self._given(given)
        if actions is None:
            actions = video.new_zeros(len(video), 0, len(self.action_low))
        return StateStream(self, video, actions, _generators(video, len(video), seeds))

    def named_states(self, values: Tensor) -> dict[str, Tensor]:
        """States `[B, T, S]` as the fields that they are, `[B, T, …]` by name."""
        named, start = dict[str, Tensor](), 0
        for name, shape in self.state_shapes.items():
            part = values[..., start : start + math.prod(shape)]
            named[name] = part.reshape(*values.shape[:2], *shape)
            start += math.prod(shape)
        return named

    @property
    def keypoint_names(self) -> tuple[str, ...]:
        """The things whose place in the picture the model knows; see `Predictor`."""
        return self.model.keypoint_names if isinstance(self.model, Predictor) else ()

    @torch.no_grad()
    def read_keypoints(self, video: Video) -> Keypoints:
        """Where the model sees things in a video `[B, T, 3, H, W]`, in each latent frame.

        Raises:
            RecipeError: the model sees no keypoints.
        """
        return self._seeing().read_keypoints(self.codec.encode(self._given(video)))

    @torch.no_grad()
    def predict_keypoints(
        self, given: Frame | Video, actions: Actions, *, seeds: Sequence[int] | None = None
    ) -> Keypoints:
        """Where the model expects them in the latent frames after the given ones.

        The arguments are those of `predict_states`.

        Raises:
            RecipeError: the model sees no keypoints.
        """
        model, video = self._seeing(), self._given(given)
        length = self.codec.latent_frames(actions.shape[1])
        return model.predict_keypoints(
            self.codec.encode(video),
            self.condition(actions, length),
            length,
            _generators(video, len(actions), seeds),
        )

    def _seeing(self) -> Predictor:
        if not isinstance(self.model, Predictor) or not self.model.keypoint_names:
            raise RecipeError(f"{type(self.model).__name__} sees no keypoints")
        return self.model

    @property
    def predicts_states(self) -> bool:
        """Whether the model can predict states, and knows which fields of the card they are."""
        able = isinstance(self.model, Predictor) and self.model.implements("predict_states")
        return able and bool(self.state_shapes)

    @float32_by_default()
    def rollout(
        self,
        given: Frame | Video,
        actions: Actions,
        *,
        mode: Mode | None = None,
        steps: int | None = None,
        window: int | None = None,
        seeds: Sequence[int] | None = None,
        check: bool = True,
    ) -> Video:
        """Predict a whole video, `[B, T, 3, H, W]`; see `rollout_chunks` for the other arguments.

        `check` refuses frames and actions that no model was trained on. Without it they are used as
        they are, e.g. recorded actions that are out of bounds.
        """
        if check:
            check_pixels(given)
            self.checked(actions[:, :-1])
        chunks = self.rollout_chunks(
            given, actions, mode=mode, steps=steps, window=window, seeds=seeds
        )
        return torch.cat([*chunks], dim=1)

    @torch.no_grad()
    def rollout_chunks(
        self,
        given: Frame | Video,
        actions: Actions,
        *,
        mode: Mode | None = None,
        steps: int | None = None,
        window: int | None = None,
        seeds: Sequence[int] | None = None,
    ) -> Iterator[Video]:
        """Predict the video that starts with the given frames; only a chunk is in memory at a time.

        Actions are not checked, so recorded actions may be out of their bounds.

        Args:
            given: the first frame `[B, 3, H, W]`, or the first K `[B, K, 3, H, W]`, in [0, 1]; K
                must be whole latent frames. The model was trained with `context_frames`.
            actions: raw actions `[B, T, A]`; row i leads from frame i to i + 1, the last is unused.
            mode: how to proceed, see `Mode`; this model's `mode` by default.
            steps: network evaluations; the model's default if None.
            window: frames per window, more than K; for a stream, how far back a frame may see.
                `clip_frames` by default.
            seeds: one per batch element, so that its noise does not depend on the other elements;
                0, 1, … by default.

        Yields:
            The frames in chunks; the first K are the codec's reconstruction of the given ones.

        Raises:
            ShapeError: batch sizes differ, there are too few frames, the window is too small, or
                the K frames are no whole latent frames.
            ShapeError: wrong action size.
            RecipeError: `mode` is unknown, or "stream" and the components cannot be streamed.
        """
        video = self._given(given)
        known, frames = video.shape[1], actions.shape[1]
        mode = self.mode if mode is None else mode
        if mode not in get_args(Mode):
            raise RecipeError(f"mode={mode!r} must be one of {', '.join(get_args(Mode))}")
        window = self.clip_frames if window is None else window
        if mode == "whole":
            window = max(frames, known + 1)
        if window <= known or frames < known:
            raise ShapeError(
                f"a rollout of {frames} frames in windows of {window} after {known} given frames "
                "predicts nothing"
            )
        generators = _generators(video, len(actions), seeds)
        if mode == "stream":
            between, context = actions[:, : known - 1], self.codec.latent_frames(window)
            stream = Stream(
                self, video, between, steps=steps, context=context, generators=generators
            )
            yield stream.given
            yield from stream.play(actions[:, known - 1 : -1], DECODED_TOGETHER, check=False)
            return
        codec = self.codec.with_reference(video[:, -1])
        for start in range(0, max(frames - known, 1), window - known):
            rows = actions[:, start : start + window]
            latents = self._predict(video, rows, steps, generators)
            chunk = codec.decode(latents, frames=rows.shape[1])
            video = chunk[:, -known:]
            yield chunk if start == 0 else chunk[:, known:]

    @float32_by_default()
    def stream(
        self,
        given: Frame | Video,
        actions: Actions | None = None,
        *,
        steps: int | None = None,
        context: int | None = None,
        seeds: Sequence[int] | None = None,
    ) -> Stream:
        """Start a stream: a video of any length that continues as actions arrive.

        Args:
            given: the first frames, as for `rollout_chunks`.
            actions: raw actions between them, `[B, K − 1, A]`; none for a single frame.
            steps: network evaluations; the model's default if None.
            context: number of latent frames that a frame sees, including itself; by default those
                of `clip_frames` frames, the longest past that the model was trained with.
            seeds: one per batch element; 0, 1, … by default.

        Raises:
            RecipeError: the components cannot be streamed.
            ShapeError: there is not one seed per batch element, frames or actions don't fit, or
                frames are not float in [0, 1].
            ShapeError: actions have the wrong size or are not finite.
        """
        check_pixels(given)
        video = self._given(given)
        if actions is None:
            actions = video.new_zeros(len(video), 0, len(self.action_low))
        if not actions.isfinite().all():
            raise ShapeError("the actions are not finite")
        context = self.codec.latent_frames(self.clip_frames) if context is None else context
        generators = _generators(video, len(video), seeds)
        return Stream(self, video, actions, steps=steps, context=context, generators=generators)

    def _given(self, given: Frame | Video) -> Video:
        """Check the given frames and return them as `[B, K, 3, H, W]`."""
        video = given[:, None] if given.ndim == 4 else given
        stride = self.codec.temporal_stride
        if video.ndim != 5 or video.shape[2] != 3 or (video.shape[1] - 1) % stride:
            raise ShapeError(
                f"a model takes frames [B, 3, H, W] or [B, K, 3, H, W], K = 1 + n·"
                f"{stride}, not {list(given.shape)}"
            )
        return self._as_own(video)

    @torch.no_grad()
    def predict_latents(
        self,
        given: Frame | Video,
        actions: Actions,
        *,
        steps: int | None = None,
        seeds: Sequence[int] | None = None,
    ) -> Latent:
        """Predict latents `[B, L, C, h, w]`, the given frames' first, in one window.

        Args:
            given: the first frames, as for `rollout_chunks`.
            actions: raw actions `[B, T, A]` of all frames.
            steps: network evaluations; the model's default if None.
            seeds: one per batch element; 0, 1, … by default.
        """
        video = self._given(given)
        return self._predict(video, actions, steps, _generators(video, len(actions), seeds))

    def _predict(
        self,
        given: Video,
        actions: Actions,
        steps: int | None,
        generators: Sequence[torch.Generator],
    ) -> Latent:
        """Predict the latents of one window, with as many frames as there are action rows."""
        latents, length = self.codec.encode(given), self.codec.latent_frames(actions.shape[1])
        if length > latents.shape[1]:
            begin = Batch(latents, self.condition(actions, length), generators)
            latents = self.objective.predict(self.model, begin, length, steps)
        return latents

    def checked(self, actions: Actions) -> Actions:
        """Check a user's raw actions `[B, T, A]` and return them unchanged.

        Raises:
            ShapeError: they do not have three dimensions.
            ShapeError: wrong action size, not finite, or out of bounds.
        """
        if actions.ndim != 3:
            raise ShapeError(f"actions are [B, T, A], not {list(actions.shape)}")
        self.normalise(actions)
        if not actions.isfinite().all():
            raise ShapeError("the actions are not finite")
        low, high = self.action_low, self.action_high
        slack = 1e-6 * (high - low)  # float32 rounding of a bound is no violation
        outside = ((actions < low - slack) | (actions > high + slack)).flatten(0, 1).any(0)
        if outside.any():
            size = int(outside.int().argmax())
            raise ShapeError(
                f"dimension {size} of the actions is out of its bounds "
                f"[{low[size]:g}, {high[size]:g}]: clip it, with "
                "actions.clamp(world_model.action_low, world_model.action_high)"
            )
        return actions

    def _as_own(self, values: Tensor) -> Tensor:
        """Double precision, which NumPy gives, in the model's own."""
        is_double = values.dtype == torch.float64 != self.action_low.dtype
        return values.float() if is_double else values

    def normalise(self, actions: Actions) -> Actions:
        """Scale raw actions `[B, T, A]` to [-1, 1] by their bounds."""
        if actions.shape[2] != len(self.action_low):
            raise ShapeError(
                f"the model was built for {len(self.action_low)} action dimensions, "
                f"not {actions.shape[2]}"
            )
        rows = self._as_own(actions)
        return 2 * (rows - self.action_low) / (self.action_high - self.action_low) - 1

    def _prepare(self, actions: Actions, latent_frames: int) -> Actions:
        """Normalise, fill up the last latent frame, and zero the last row, which leads to no frame.

        The last action is repeated to fill it up: a row of zeros would be an action as well, and
        would command another position where actions are targets.
        """
        missing = self.codec.video_frames(latent_frames) - actions.shape[1]
        rows = continued(actions[:, :-1], missing)
        return self.normalise(nn.functional.pad(rows, (0, 0, 0, 1)))


def _generators(given: Video, batch: int, seeds: Sequence[int] | None) -> list[torch.Generator]:
    """One noise generator per batch element, from its seed, which may be NumPy's or PyTorch's."""
    try:
        chosen = [*map(operator.index, range(batch) if seeds is None else seeds)]
    except TypeError:
        raise ShapeError(f"seeds are a whole number per batch element, not {seeds!r:.60}") from None
    if too_large := next((seed for seed in chosen if not -(2**63) <= seed < 2**64), None):
        raise ShapeError(f"the seed {too_large} has more than 64 bits: give a smaller one")
    if not len(given) == batch == len(chosen):
        raise ShapeError(
            f"{len(given)} first frames for {batch} action sequences and {len(chosen)} seeds"
        )
    return [torch.Generator().manual_seed(seed) for seed in chosen]
