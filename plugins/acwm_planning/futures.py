"""A world model's predictions for candidates. Only the frames that a cost looks at are decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

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
from acwm_core.model.codec import Codec, cpu_has_fast_bfloat16
from acwm_core.model.objectives.objective import Batch
from acwm_core.model.shapes import Actions, Clip, Latent, Video
from acwm_core.model.stream import continued
from acwm_core.model.world_model import WorldModel
from acwm_planning.planner import Cost, Futures, RolloutCost


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
        latents: predicted latents after `before`, `[N, L, C, h, w]`.
        before: the latent frames up to now, `[N, K, C, h, w]`.
        last: index, within the last latent frame, of the last planned video frame.
        estimator: reads states from frames, if there is one.
        stills: pictures and their latent frames, encoded before; shared within a decision.
    """

    def __init__(
        self,
        codec: Codec,
        latents: Latent,
        before: Latent,
        last: int,
        estimator: StateEstimator | None,
        stills: list[tuple[Frame, Latent]],
    ) -> None:
        self._codec, self._latents, self._before = codec, latents, before
        self._last, self._estimator, self._stills = last, estimator, stills
        self.length = latents.shape[1]

    @property
    def finite(self) -> Tensor:
        """Which candidates have a finite prediction, `[N]`."""
        return self._latents.detach().isfinite().flatten(1).all(1)

    def latents(self, frames: Sequence[int]) -> Latent:
        """They carry a gradient if the predicted latents do."""
        return self._latents[:, list(frames)]

    @torch.no_grad()
    def video(self, frames: Sequence[int]) -> Video:
        """With a memoryless codec, only these frames are decoded.

        On a CPU that has it, in bfloat16: decoding takes most of a decision, and is twice as fast.
        """
        device = self._latents.device.type
        fast = device == "cpu" and cpu_has_fast_bfloat16()
        with torch.autocast(device, torch.bfloat16, enabled=fast):
            return self._decode(list(frames)).float()

    def _decode(self, chosen: list[int]) -> Video:
        stride = self._codec.temporal_stride
        places = [self._last if frame == self.length - 1 else stride - 1 for frame in chosen]
        if self._codec.memoryless:
            decode, starts = self._codec.frame_decoder(), range(0, stride * len(chosen), stride)
            decode(self._before[:1, :1])  # the first latent frame of a video is special
            video = decode(self._latents[:, chosen])
        else:
            video = self._codec.decode(torch.cat([self._before, self._latents], 1))
            starts = [video.shape[1] - stride * (self.length - frame) for frame in chosen]
        return video[:, [start + place for start, place in zip(starts, places, strict=True)]]

    def observe(self, frames: Sequence[int]) -> Observation:
        """The estimator reads the decoded frames.

        Raises:
            DataError: there is no estimator for this environment.
        """
        if self._estimator is None:
            raise DataError(
                "no estimator reads the states of this environment from pictures, which the cost "
                "needs: take cost=latent"
            )
        return self._estimator.read(self.video(frames).flatten(0, 1).cpu())

    def still(self, picture: Frame) -> Latent:
        """Each picture is encoded once per decision."""
        for known, latent in self._stills:
            if known is picture:
                return latent
        latent = still_latent(self._codec, picture, self._latents.device)
        self._stills.append((picture, latent))
        return latent


class _Given(NamedTuple):
    """What a decision knows: the codec with the last given frame, latents and actions up to now."""

    codec: Codec
    latents: Latent
    actions: Tensor

    @property
    def frames(self) -> int:
        """Number of video frames from the first given one to the current one."""
        return 1 + self.actions.shape[1]


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
    ) -> None:
        self.world_model, self.card = world_model, card
        self._estimator, self._past, self._steps, self._batch = estimator, past, steps, batch

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

        def cost(actions: Actions) -> Tensor:
            costs: list[Tensor] = []
            for part in actions.split(self._batch):
                futures = self._futures(given, part, seed, stills)
                # An estimator may read something from a picture that is not finite.
                finite, readable = futures.finite.cpu(), goal_cost(futures, len(part)).cpu()
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

    def _given(self, history: History, still: NDArray[np.float32]) -> _Given:
        world = self.world_model
        known, stride = world.context_frames, world.codec.temporal_stride
        past = min(self._past, len(history.actions) // stride) * stride
        before = max(0, known - 1 - (len(history.actions) - past))  # frames before the start
        frames = [history.frames[0]] * before + history.frames
        actions = [still] * before + history.actions
        first = len(frames) - past - known
        device = world.action_low.device
        video = as_clip(np.stack(frames[first : first + known]))[None].to(device)
        recent = np.array(actions[first:], np.float32).reshape(1, known - 1 + past, len(still))
        codec = world.codec.with_reference(video[:, -1])
        return _Given(codec, world.encode(video), torch.from_numpy(recent))

    def _futures(
        self,
        given: _Given,
        actions: Actions,
        seed: int,
        stills: list[tuple[Frame, Latent]],
    ) -> ModelFutures:
        with torch.set_grad_enabled(actions.requires_grad):
            latents = self._predict(given, actions, seed)
        codec = given.codec
        now = codec.latent_frames(given.frames)
        last = (actions.shape[1] - 1) % codec.temporal_stride
        before, after = latents[:, :now], latents[:, now:]
        return ModelFutures(codec, after, before, last, self._estimator, stills)

    def _predict(self, given: _Given, actions: Actions, seed: int) -> Latent:
        """All latent frames, including the given ones, `[N, L, C, h, w]`."""
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
        begin = Batch(latents, conditioning, generators)
        return world.objective.predict(world.model, begin, length, self._steps)
