"""A world model's predictions for candidates.

Only the frames that a cost looks at are decoded, and predicted if the model saves the work.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.env.task import Frame, Goal, Task
from acwm_core.errors import DataError, RecipeError, check_shape
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.batch import Batch
from acwm_core.model.codec import Codec
from acwm_core.model.dynamics import Keypoints, Predictor
from acwm_core.model.precision import bfloat16_is_fast
from acwm_core.model.shapes import Actions, Clip, Latent, Video
from acwm_core.model.stream import continued
from acwm_core.model.world_model import WorldModel
from acwm_planning.planner import Cost, Futures, RolloutCost
from acwm_planning.predicted import LazyFields, observation_of
from acwm_planning.states import CandidateStates, Given


@dataclass
class History:
    """What has happened in an episode so far, in the simulator.

    Attributes:
        spec: spec of the episode.
        frames: all frames so far, `[H, W, 3]` each; the last one is the current frame.
        actions: raw actions between the frames, `[A]` each.
    """

    spec: EpisodeSpec
    frames: list[Frame]
    actions: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])


@dataclass(frozen=True)
class GoalCost:
    """The cost of reaching a goal: a `Cost` with what it is asked about."""

    cost: Cost
    task: Task
    goal: Goal

    def __call__(self, futures: Futures, number: int) -> Tensor:
        """Costs `[number]` of the futures of so many candidates."""
        costs = self.cost(futures, self.task, self.goal)
        check_shape(self.cost, "__call__", costs, number)
        return costs


def still_latent(codec: Codec, picture: Frame, device: torch.device) -> Latent:
    """Encode a still picture as a latent frame, as it is after a video's first frame."""
    video = as_clip(np.stack([picture] * (1 + codec.temporal_stride)))[None].to(device)
    with torch.no_grad():
        return codec.encode(video)[:, -1:]


class ModelFutures(Futures):
    """The futures that a model predicts for candidates.

    Args:
        codec: codec of the latents, which knows the current frame.
        given: the latent frames that the prediction begins with, `[N, K, C, h, w]`.
        past: number of latent frames between them and the plan; the last of them is numbered -1.
        length: number of planned latent frames.
        predict: predicts the latent frames of these numbers, `[N, len(frames), C, h, w]`.
        last: index, within the last latent frame, of the last planned video frame.
        estimator: reads states from frames, if there is one.
        stills: pictures and their latent frames, encoded before; shared within a decision.
        states: predicts the fields of the states in the planned video frames, the one of a name
            and maybe others, `[N, T, …]` each, if the model can.
        fields: their names.
        expects: where the model expects things in the planned latent frames, if it sees any.
        reads: where it sees them in latent frames `[1, 1, C, h, w]`.
    """

    def __init__(
        self,
        codec: Codec,
        given: Latent,
        past: int,
        length: int,
        predict: Callable[[Sequence[int]], Latent],
        last: int,
        estimator: StateEstimator | None,
        stills: list[tuple[Frame, Latent]],
        states: Callable[[str], Mapping[str, Tensor]] | None = None,
        fields: Collection[str] = (),
        expects: Callable[[], Keypoints] | None = None,
        reads: Callable[[Latent], Keypoints] | None = None,
    ) -> None:
        self._codec, self._given, self._past, self._predict = codec, given, past, predict
        self._last, self._estimator, self._stills = last, estimator, stills
        self.length = length
        self._states, self._fields = states, fields
        self._latents: dict[int, Latent] = {}
        self._predicted: Mapping[str, Tensor] = {}
        self._expects, self._reads = expects, reads
        self._keypoints: Keypoints | None = None

    @property
    def finite(self) -> Tensor:
        """Which candidates' predictions are finite, `[N]`, in what was asked for."""
        if not self._latents:
            if self._predicted:
                parts = [values.flatten(2) for values in self._predicted.values()]
                return _finite_states(torch.cat(parts, 2))
            if self._keypoints is not None:
                return _finite_states(self._keypoints.values.detach().flatten(2))
        self.latents([self.length - 1])
        latents = torch.stack(list(self._latents.values()), 1)
        return latents.detach().isfinite().flatten(1).all(1)

    @property
    def encoding(self) -> str:
        """That of the codec."""
        return self._codec.latents_fingerprint()

    def latents(self, frames: Sequence[int]) -> Latent:
        """They carry a gradient if the predicted latents do. Each is predicted once."""
        missing = [frame for frame in frames if frame not in self._latents]
        if missing:
            self._latents.update(zip(missing, self._predict(missing).unbind(1), strict=True))
        return torch.stack([self._latents[frame] for frame in frames], 1)

    @torch.no_grad()
    def video(self, frames: Sequence[int]) -> Video:
        """With a memoryless codec, only these frames are decoded.

        On a CPU that has it, in bfloat16: decoding takes most of a decision, and is twice as fast.
        """
        device = self._given.device.type
        fast = device == "cpu" and bfloat16_is_fast()
        with torch.autocast(device, torch.bfloat16, enabled=fast):
            return self._decode(list(frames)).float()

    def _decode(self, frames: list[int]) -> Video:
        stride = self._codec.temporal_stride
        offsets = [self._offset(frame) for frame in frames]
        if self._codec.memoryless:
            decode, starts = self._codec.frame_decoder(), range(0, stride * len(frames), stride)
            decode(self._given[:1, :1])  # the first latent frame of a video is special
            video = decode(self.latents(frames))
        else:
            later = self.latents(range(-self._past, self.length))
            video = self._codec.decode(torch.cat([self._given, later], 1))
            starts = [video.shape[1] - stride * (self.length - frame) for frame in frames]
        return video[:, [start + offset for start, offset in zip(starts, offsets, strict=True)]]

    def _offset(self, frame: int) -> int:
        """Index of a latent frame's last planned video frame within it."""
        return self._last if frame == self.length - 1 else self._codec.temporal_stride - 1

    def observe(self, frames: Sequence[int]) -> Observation:
        """The estimator reads the decoded frames.

        Raises:
            DataError: there is no estimator for this environment.
        """
        if self._estimator is None:
            raise DataError(
                "no estimator reads the states of this environment from pictures, and the model "
                "predicts too few: take cost=latent, or a reward of latents (`acwm train-reward "
                "--latents`)"
            )
        return self._estimator.read(self.video(frames).flatten(0, 1).cpu())

    def predicted(self, frames: Sequence[int]) -> Observation | None:
        """The states of the last video frame of each latent frame, which are predicted once."""
        if self._states is None:
            return None
        stride, candidates = self._codec.temporal_stride, len(self._given)
        video_frames = [frame * stride + self._offset(frame) for frame in frames]
        fields = LazyFields(
            self._fields, lambda name: self._field(name)[:, video_frames].flatten(0, 1).cpu()
        )
        return observation_of(fields, candidates * len(frames))

    def _field(self, name: str) -> Tensor:
        """A field of the states in the planned video frames, `[N, T, …]`."""
        assert self._states is not None
        if name not in self._predicted:
            self._predicted = self._states(name)
        return self._predicted[name]

    def keypoints(self, frames: Sequence[int]) -> Keypoints | None:
        """They carry a gradient if the actions do, and are predicted once."""
        if self._expects is None:
            return None
        if self._keypoints is None:
            self._keypoints = self._expects()
        return self._keypoints._replace(values=self._keypoints.values[:, list(frames)])

    def keypoints_of(self, picture: Frame) -> Keypoints | None:
        """Those that the model reads in the latent frame of a still picture."""
        if self._reads is None:
            return None
        with torch.no_grad():
            return self._reads(self.still(picture))

    def still(self, picture: Frame) -> Latent:
        """Each picture is encoded once per decision."""
        for encoded, latent in self._stills:
            if encoded is picture:
                return latent
        latent = still_latent(self._codec, picture, self._given.device)
        self._stills.append((picture, latent))
        return latent


def reads_of(world_model: WorldModel) -> Callable[[Latent], Keypoints] | None:
    """What reads keypoints in latent frames; None if the model sees none."""
    model = world_model.model
    return cast(Predictor, model).read_keypoints if world_model.keypoint_names else None


def _finite_states(states: Tensor) -> Tensor:
    """For which clips, `[N]`, states `[N, T, S]` are finite that the model knows of any of them."""
    finite = states.isfinite()
    predicted = finite.any(1).any(0)
    return finite[..., predicted].flatten(1).all(1) & predicted.any()


class ModelRollouts:
    """Predicts the futures of candidates with a model.

    The real frames are encoded once for all candidates. All candidates get the same noise, so they
    differ only in their actions. Each decision starts again from real frames: from the last ones,
    as many as the context frames that the model was trained with. With `past`, they are taken that
    many latent frames earlier, and the model is also given the actions taken since. Before the
    start of an episode, everything is assumed to stand still.

    Args:
        world_model: the world model, in evaluation mode.
        card: card of its environment.
        estimator: reads states from its frames, if there is one.
        past: latent frames between the given frames and now. They cost time and add drift, but show
            a model with a single context frame how fast things move.
        steps: sampling steps; the model's own number by default.
        batch: number of candidates that are rolled out at once.
        state_past: as `past`, and instead of it with a model that carries states on: these frames
            are predicted once for all candidates, and without pictures.
    """

    def __init__(
        self,
        world_model: WorldModel,
        card: EnvironmentCard,
        estimator: StateEstimator | None,
        *,
        past: int = 0,
        steps: int | None = None,
        batch: int = 128,
        state_past: int | None = None,
    ) -> None:
        self.world_model, self.card = world_model, card
        model = world_model.model
        carries = isinstance(model, Predictor) and model.implements("carry_states")
        if carries and world_model.state_shapes and state_past is not None:
            past = state_past
        self._estimator, self._past, self._steps, self._batch = estimator, past, steps, batch
        self._asked = set[str]()

    def cost(
        self, history: History, still: NDArray[np.float32], goal_cost: GoalCost, seed: int
    ) -> RolloutCost:
        """A function that maps candidates `[N, T, A]`, which continue `history`, to costs `[N]`.

        Args:
            history: the episode so far.
            still: the action that means no motion, assumed before the start.
            goal_cost: cost of the candidates' futures.
            seed: seed of the model's noise.
        """
        given = self._given(history, still)
        stills: list[tuple[Frame, Latent]] = []
        states = CandidateStates(
            *(self.world_model, given, seed, self._asked),
            lambda actions: self._predict_states(given, actions, seed),
        )

        def cost(actions: Actions) -> Tensor:
            costs: list[Tensor] = []
            for part in actions.split(self._batch):
                futures = self._futures(given, part, seed, stills, states)
                # An estimator may read something from a picture that is not finite.
                readable, finite = goal_cost(futures, len(part)).cpu(), futures.finite.cpu()
                costs.append(torch.where(finite, readable, torch.nan))
            return torch.cat(costs)

        return cost

    @torch.no_grad()
    def imagine(
        self, history: History, still: NDArray[np.float32], actions: Tensor, seed: int
    ) -> Clip:
        """Predict the video `[T, 3, H, W]` of one candidate `[T, A]`."""
        given = self._given(history, still)
        latents = self._predict(given, actions[None], seed)
        frames = given.codec.decode(latents)[0]
        return frames[given.frames :][: len(actions)].cpu()

    def recent(self, history: History, still: NDArray[np.float32]) -> tuple[Video, Actions]:
        """The real frames `[1, K, 3, H, W]` to start from, and the raw actions `[1, T, A]` since.

        The first K − 1 actions lie between the frames. Actions are on the CPU.
        """
        world = self.world_model
        context, stride = world.context_frames, world.codec.temporal_stride
        past = min(self._past, len(history.actions) // stride) * stride
        padding = max(0, context - 1 - (len(history.actions) - past))  # frames before the start
        frames = [history.frames[0]] * padding + history.frames
        actions = [still] * padding + history.actions
        first = len(frames) - past - context
        device = world.action_low.device
        video = as_clip(np.stack(frames[first : first + context]))[None].to(device)
        recent = np.array(actions[first:], np.float32).reshape(1, context - 1 + past, len(still))
        return video, torch.from_numpy(recent)

    def _given(self, history: History, still: NDArray[np.float32]) -> Given:
        video, recent = self.recent(history, still)
        codec = self.world_model.codec.with_reference(video[:, -1])
        return Given(codec, video, self.world_model.encode(video), recent)

    def _futures(
        self,
        given: Given,
        actions: Actions,
        seed: int,
        stills: list[tuple[Frame, Latent]],
        states: CandidateStates,
    ) -> ModelFutures:
        codec, stride, context = given.codec, given.codec.temporal_stride, given.latents.shape[1]
        past = codec.latent_frames(given.frames) - context
        length, last = -(-actions.shape[1] // stride), (actions.shape[1] - 1) % stride

        def predict(frames: Sequence[int]) -> Latent:
            numbers = [context + past + frame for frame in frames]
            with torch.set_grad_enabled(actions.requires_grad):
                return self._predict(given, actions, seed, numbers)

        def expected() -> Keypoints:
            with torch.set_grad_enabled(actions.requires_grad):
                keypoints = self._predict_keypoints(given, actions, seed)
            return keypoints._replace(values=keypoints.values[:, past:])

        latents = given.latents.expand(len(actions), -1, -1, -1, -1)
        world = self.world_model
        own = partial(states, actions) if world.predicts_states else None
        expects = expected if world.keypoint_names else None
        futures = ModelFutures(
            codec,
            latents,
            past,
            length,
            predict,
            last,
            self._estimator,
            stills,
            own,
            world.state_shapes.keys(),
            expects,
            reads_of(world),
        )
        model = world.model
        if not (isinstance(model, Predictor) and model.implements("predict_frames")):
            futures.latents(range(-past, length))  # all at once
        return futures

    def _predict(
        self, given: Given, actions: Actions, seed: int, only: Sequence[int] | None = None
    ) -> Latent:
        """All latent frames, including the given ones, `[N, L, C, h, w]`; or only these."""
        world, (begin, length) = self.world_model, self._begun(given, actions, seed)
        if only is None:
            return world.objective.predict(world.model, begin, length, self._steps)
        return world.objective.predict_frames(world.model, begin, length, only, self._steps)

    @torch.no_grad()
    def _predict_states(self, given: Given, actions: Actions, seed: int) -> Tensor:
        """The states in all video frames after the given ones, `[N, T, S]`."""
        begin, length = self._begun(given, actions, seed)
        model = cast(Predictor, self.world_model.model)
        return model.predict_states(given.latents, begin.conditioning, length, begin.generators)

    def _predict_keypoints(self, given: Given, actions: Actions, seed: int) -> Keypoints:
        """In the latent frames after the given ones."""
        begin, length = self._begun(given, actions, seed)
        model = cast(Predictor, self.world_model.model)
        return model.predict_keypoints(given.latents, begin.conditioning, length, begin.generators)

    def _begun(self, given: Given, actions: Actions, seed: int) -> tuple[Batch, int]:
        """The beginning of the candidates' clips, and their number of latent frames."""
        world, number, recent = self.world_model, len(actions), given.actions
        rows = torch.cat([recent.expand(number, -1, -1), actions], 1).to(world.action_low.device)
        stride = world.codec.temporal_stride
        rows = continued(rows, -rows.shape[1] % stride)
        length = 1 + rows.shape[1] // stride
        most = world.codec.latent_frames(world.clip_frames)
        if length > most and not world.objective.streams_by_default(world.model):
            fitting = (most - 1) * stride - recent.shape[1]
            advice = f"plan at most {fitting} actions (planner.horizon · planner.action_block)"
            raise RecipeError(
                f"the model was trained on clips of {world.clip_frames} frames, and this plan "
                f"needs {world.codec.video_frames(length)}: "
                + (advice if fitting > 0 else "reduce past=")
            )
        normalised = world.normalise(torch.nn.functional.pad(rows, (0, 0, 0, 1)))
        conditioning = world.conditioner.condition(normalised, length, world.model.width)
        generators = [torch.Generator().manual_seed(seed) for _ in range(number)]
        latents = given.latents.expand(number, -1, -1, -1, -1)
        return Batch(latents, conditioning, generators), length
