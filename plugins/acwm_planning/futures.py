"""What a world model imagines of candidates: latents, and pictures only of what a cost looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.codec import Codec
from acwm_core.environment import EnvironmentCard
from acwm_core.episode import EpisodeSpec
from acwm_core.errors import DataError, RecipeError
from acwm_core.errors.plugin_code import shaped
from acwm_core.estimator import Observation, StateEstimator
from acwm_core.planning.planner import Cost, Futures, RolloutCost
from acwm_core.planning.task import Frame, Goal, Task
from acwm_core.shapes import Actions, Clip, Latent, Video
from acwm_core.streaming import continued
from acwm_core.world_model import WorldModel


@dataclass
class History:
    """What has happened in an episode so far, in the real world.

    Attributes:
        spec: of the episode.
        frames: all pictures, the last one of now, `[H, W, 3]` each.
        actions: raw actions between them, `[A]` each.
    """

    spec: EpisodeSpec
    frames: list[Frame]
    actions: list[NDArray[np.float32]] = field(default_factory=list[NDArray[np.float32]])


def tensor_of(frames: Sequence[Frame]) -> Video:
    """Pictures `[H, W, 3]` as `[1, T, 3, H, W]` in [0, 1]."""
    return torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)[None].float() / 255


def still_latent(codec: Codec, picture: Frame) -> Latent:
    """The latent frame of a picture that stands still, as it is after a video's first frame."""
    device = next((p.device for p in codec.parameters()), torch.device("cpu"))
    video = tensor_of([picture] * (1 + codec.temporal_stride)).to(device)
    with torch.no_grad():
        return codec.encode(video)[:, -1:]


class ModelFutures(Futures):
    """Futures of candidates in a model.

    Args:
        codec: of the latents.
        latents: predicted, `[N, L, C, h, w]`, after `before`.
        before: the latent frames until now, `[N, K, C, h, w]`.
        last: which picture of the last latent frame is the last one planned, from 0.
        estimator: reads pictures, if there is one.
        stills: latent frames of pictures by their `id`, which all futures of a decision share.
    """

    def __init__(
        self,
        codec: Codec,
        latents: Latent,
        before: Latent,
        last: int,
        estimator: StateEstimator | None,
        stills: dict[int, Latent],
    ) -> None:
        self._codec, self._latents, self._before = codec, latents, before
        self._last, self._estimator, self._stills = last, estimator, stills
        self.length = latents.shape[1]

    def latents(self, frames: Sequence[int]) -> Latent:
        """See `Futures.latents`; they have a gradient if the model's have."""
        return self._latents[:, list(frames)]

    @torch.no_grad()
    def video(self, frames: Sequence[int]) -> Video:
        """See `Futures.video`; a codec that is memoryless decodes nothing else."""
        stride, chosen = self._codec.temporal_stride, list(frames)
        places = [self._last if frame == self.length - 1 else stride - 1 for frame in chosen]
        if self._codec.memoryless:
            decode, starts = self._codec.frame_decoder(), range(0, stride * len(chosen), stride)
            decode(self._before[:1, :1])  # a video's first latent frame is a special one
            video = decode(self._latents[:, chosen])
        else:
            video = self._codec.decode(torch.cat([self._before, self._latents], 1))
            starts = [video.shape[1] - stride * (self.length - frame) for frame in chosen]
        return video[:, [start + place for start, place in zip(starts, places, strict=True)]]

    def observe(self, frames: Sequence[int]) -> Observation:
        """See `Futures.observe`; read by the estimator.

        Raises:
            DataError: there is none for this environment.
        """
        if self._estimator is None:
            raise DataError(
                "no estimator reads the states of this environment from pictures, which the cost "
                "needs: take cost=latent"
            )
        return self._estimator.read(self.video(frames).flatten(0, 1).cpu())

    def still(self, picture: Frame) -> Latent:
        """See `Futures.still`; encoded once for a decision."""
        if id(picture) not in self._stills:
            self._stills[id(picture)] = still_latent(self._codec, picture)
        return self._stills[id(picture)]


class ModelRollouts:
    """The futures that a model imagines after what has happened.

    The real frames are encoded once for all candidates, and all get the same noise, so that
    candidates differ by their actions alone. Each decision starts from real frames anew: the last
    ones, as many as the model was trained to be given, or those so many latent frames of `past`
    earlier, with the actions taken since. Before an episode's start all stood still.

    Args:
        world_model: in evaluation mode.
        card: of its environment.
        estimator: reads its pictures, if there is one.
        past: latent frames between the given frames and now. They cost time and drift, but a model
            that is given a single frame sees by them how fast things move.
        steps: sampling steps; the model's own number by default.
        batch: candidates that are rolled out at once.

    Raises:
        RecipeError: a number that is too small.
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
        for name, value, least in (
            ("past", past, 0),
            ("steps", 1 if steps is None else steps, 1),
            ("batch", batch, 1),
        ):
            if value < least:
                raise RecipeError(f"{name}={value}: give {least} or more")
        self.world_model, self.card = world_model, card
        self._estimator, self._past, self._steps, self._batch = estimator, past, steps, batch

    def cost(
        self,
        history: History,
        still: NDArray[np.float32],
        judge: Cost,
        task: Task,
        goal: Goal,
        seed: int,
    ) -> RolloutCost:
        """What candidates `[N, T, A]` cost that follow what has happened.

        Args:
            still: the action that held everything before the start.
            judge: of their futures.
            seed: of the noise.
        """
        given, taken = self._encoded(history, still)
        stills: dict[int, Latent] = {}

        def cost(actions: Actions) -> Tensor:
            parts = actions.split(self._batch)
            futures = ((part, self._futures(given, taken, part, seed, stills)) for part in parts)
            costs = (shaped(judge, "cost", judge(f, task, goal), len(p)) for p, f in futures)
            return torch.cat([each.cpu() for each in costs])

        return cost

    @torch.no_grad()
    def imagined(
        self, history: History, still: NDArray[np.float32], actions: Tensor, seed: int
    ) -> Clip:
        """The video `[T, 3, H, W]` of one candidate `[T, A]`."""
        given, taken = self._encoded(history, still)
        latents = self._predicted(given, taken, actions[None], seed)
        frames = self.world_model.codec.decode(latents)[0]
        return frames[self._known(given, taken) :][: len(actions)].cpu()

    def _encoded(self, history: History, still: NDArray[np.float32]) -> tuple[Latent, Tensor]:
        """Latents of the given frames `[1, K, C, h, w]`, and the actions `[1, n, A]` until now."""
        world = self.world_model
        known, stride = world.context_frames, world.codec.temporal_stride
        past = min(self._past, len(history.actions) // stride) * stride
        before = max(0, known - 1 - (len(history.actions) - past))  # frames before the start
        frames = [history.frames[0]] * before + history.frames
        actions = [still] * before + history.actions
        first = len(frames) - past - known
        device = world.action_low.device
        given = world.encode(tensor_of(frames[first : first + known]).to(device))
        taken = np.array(actions[first:], np.float32).reshape(1, known - 1 + past, len(still))
        return given, torch.from_numpy(taken)

    def _futures(
        self, given: Latent, taken: Tensor, actions: Actions, seed: int, stills: dict[int, Latent]
    ) -> ModelFutures:
        with torch.set_grad_enabled(actions.requires_grad):
            latents = self._predicted(given, taken, actions, seed)
        codec = self.world_model.codec
        now = codec.latent_frames(self._known(given, taken))
        last = (actions.shape[1] - 1) % codec.temporal_stride
        before, after = latents[:, :now], latents[:, now:]
        return ModelFutures(codec, after, before, last, self._estimator, stills)

    def _predicted(self, given: Latent, taken: Tensor, actions: Actions, seed: int) -> Latent:
        """All latent frames, those given included, `[N, L, C, h, w]`."""
        world, number = self.world_model, len(actions)
        rows = torch.cat([taken.expand(number, -1, -1), actions], 1).to(world.action_low.device)
        stride = world.codec.temporal_stride
        rows = continued(rows, -rows.shape[1] % stride)
        length = 1 + rows.shape[1] // stride
        most = world.codec.latent_frames(world.clip_frames)
        if length > most and not world.model.streams_by_default:
            fitting = (most - 1) * stride - taken.shape[1]
            advice = f"plan at most {fitting} actions (planner.horizon · planner.action_block)"
            raise RecipeError(
                f"the model was trained to predict clips of {world.clip_frames} frames, and the "
                f"plan makes {world.codec.video_frames(length)}: "
                + (advice if fitting > 0 else "take less of the past")
            )
        normalised = world.normalise(torch.nn.functional.pad(rows, (0, 0, 0, 1)))
        conditioning = world.conditioner.condition(normalised, length, world.model.width)
        generators = [torch.Generator().manual_seed(seed) for _ in range(number)]
        given = given.expand(number, *[-1] * (given.ndim - 1))
        made = world.model.predict(given, conditioning, length, generators, self._steps)
        return shaped(world.model, "predict", made, number, length, *given.shape[2:])

    def _known(self, given: Latent, taken: Tensor) -> int:
        """Video frames until now, from the first given one on."""
        return 1 + taken.shape[1]
