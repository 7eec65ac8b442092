"""The places where policies are rolled out: the true simulator, or a model of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.pictures import to_pixels
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import noting
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.shapes import Video
from acwm_core.model.world_model import WorldModel
from acwm_planning.controllers import Controller
from acwm_planning.episode import EpisodeResult, EpisodeStart, play, start_of
from acwm_planning.policies.episode import (
    Outcome,
    join_observations,
    read_outcome,
)
from acwm_planning.policies.own import OwnController, OwnPolicy


class EpisodeSimulator:
    """The true simulator, in which policies act.

    Args:
        environment: the environment with its task.
        given: number of context frames for a model; nothing moves in them.
        stride: number of actions for which a user's policy holds its action.
        estimator: reads states for policies that observe them.
    """

    def __init__(
        self,
        environment: TaskEnvironment,
        given: int,
        stride: int,
        estimator: StateEstimator | None,
    ) -> None:
        self.environment, self._given, self._stride = environment, given, stride
        self._estimator = estimator
        self._parts = environment.environment, environment.task

    def start(self, spec: EpisodeSpec, goal: Goal | None = None) -> EpisodeStart:
        """Start an episode, with its own goal or with a given one."""
        with noting(f"in episode {spec.index} of {spec.split}", *self._parts):
            return start_of(self.environment, spec, given=self._given, goal=goal)

    def play(self, start: EpisodeStart, controller: Controller, steps: int) -> EpisodeResult:
        """Play an episode from this start, with so many actions."""
        spec = start.history.spec
        return play(
            self.environment, spec, controller, steps=steps, given=self._given, goal=start.goal
        )

    def play_own(self, start: EpisodeStart, policy: OwnPolicy, steps: int) -> EpisodeResult:
        """Play an episode with a user's policy, which observes true frames."""
        return self.play(start, OwnController(policy, self._estimator, self._stride), steps)


class ModelJudge:
    """A world model whose frames an estimator reads.

    Args:
        world_model: the world model, in evaluation mode.
        estimator: estimator of its environment.
        task: the task to judge.
        steps: sampling steps; the model's own number by default.
        batch: number of action sequences that are rolled out at once.
    """

    def __init__(
        self,
        world_model: WorldModel,
        estimator: StateEstimator,
        task: Task,
        *,
        steps: int | None = None,
        batch: int = 16,
    ) -> None:
        self._world, self._estimator, self._task = world_model, estimator, task
        self._steps, self.batch = steps, batch

    def replay(self, start: EpisodeStart, actions: Sequence[NDArray[np.float32]]) -> list[Outcome]:
        """Outcomes of sequences of raw actions, `[T, A]` each.

        All sequences get the same noise, so they differ only in actions.
        """
        outcomes: list[Outcome] = []
        for first in range(0, len(actions), self.batch):
            batch = np.stack(actions[first : first + self.batch])
            outcomes += self._replay_batch(start, torch.from_numpy(batch))
        return outcomes

    def _replay_batch(self, start: EpisodeStart, actions: Tensor) -> list[Outcome]:
        number, context = len(actions), len(start.history.frames)
        last = torch.zeros_like(actions[:, :1])  # no frame follows it
        frames, between = self._given(start)
        inputs = torch.cat([between.expand(number, -1, -1), actions, last], 1).to(self._device)
        given = frames.expand(number, -1, -1, -1, -1)
        seeds = [start.history.spec.index] * number
        observations = list[list[Observation]]()
        with noting(_when(start), *self._world.children()):
            chunks = self._world.rollout_chunks(given, inputs, steps=self._steps, seeds=seeds)
            for chunk in chunks:
                predicted = chunk[:, context:]
                context = max(0, context - chunk.shape[1])
                if predicted.shape[1]:
                    observations.append([self._estimator.read(clip.cpu()) for clip in predicted])
        return [
            read_outcome(join_observations([*parts]), self._task, start)
            for parts in zip(*observations, strict=True)
        ]

    def perform(self, start: EpisodeStart, policy: OwnPolicy, steps: int) -> Outcome:
        """Outcome of a policy after `steps` actions; it decides once per latent frame."""
        given, between = self._given(start)
        seeds = [start.history.spec.index]
        stream = self._world.stream(given, between.to(self._device), steps=self._steps, seeds=seeds)
        policy.reset(start.goal)
        frame, stride, observations = stream.given[0, -1], self._world.codec.temporal_stride, []
        for _ in range(0, steps, stride):
            action = policy.decide(to_pixels(frame[None])[0], self._estimator)
            rows = torch.from_numpy(np.stack([action] * stride))[None].to(self._device)
            with noting(_when(start), *self._world.children()):
                frames = stream.step(rows)[0]
            frame = frames[-1]
            observations.append(self._estimator.read(frames.cpu()))
        whole = join_observations(observations)
        states = {name: values[:steps] for name, values in whole.states.items()}
        return read_outcome(Observation(whole.masks[:steps], states), self._task, start)

    @property
    def _device(self) -> torch.device:
        return self._world.action_low.device

    def _given(self, start: EpisodeStart) -> tuple[Video, Tensor]:
        """Context frames on the model's device, and the raw actions between them on the CPU."""
        actions = np.array(start.history.actions, np.float32).reshape(
            -1, len(self._world.action_low)
        )
        return as_clip(start.frames)[None].to(self._device), torch.from_numpy(actions)[None]


def _when(start: EpisodeStart) -> str:
    spec = start.history.spec
    return f"in episode {spec.index} of {spec.split}, while the model predicts"
