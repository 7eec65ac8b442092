"""The places where policies are rolled out: the true simulator, or a model of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.env.task import Frame, Goal, Task, TaskEnvironment
from acwm_core.errors import noting
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.videos import to_pixels
from acwm_core.model.shapes import Video
from acwm_core.model.world_model import WorldModel
from acwm_planning.policies.episode import (
    Outcome,
    PolicyEpisode,
    Start,
    compute_outcome,
    join_observations,
    read_outcome,
)
from acwm_planning.policies.own import OwnPolicy


class Judge(ABC):
    """Rolls out actions and policies, and judges the outcomes.

    Attributes:
        batch: number of action sequences that are rolled out at once.
    """

    batch: int = 1

    @abstractmethod
    def replay(self, start: Start, actions: Sequence[NDArray[np.float32]]) -> list[Outcome]:
        """Outcomes of sequences of raw actions, `[T, A]` each."""

    @abstractmethod
    def perform(self, start: Start, policy: OwnPolicy, steps: int) -> Outcome:
        """Outcome of a policy that observes what this judge shows, after `steps` actions."""


class SimulatorJudge(Judge):
    """The true simulator.

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

    def start(self, spec: EpisodeSpec, goal: Goal | None = None) -> Start:
        """Start an episode, with its own goal or with a given one."""
        options = {"spec": spec, **({} if goal is None else {"goal": goal})}
        with noting(f"in episode {spec.index} of {spec.split}", *self._parts):
            frame, info = self.environment.reset(options=options)
            frames, actions = [frame], list[NDArray[np.float32]]()
            for _ in range(self._given - 1):
                actions.append(self.environment.environment.still_action())
                frame, _, _, _, info = self.environment.step(actions[-1])
                frames.append(frame)
        size = self.environment.environment.card.action.size
        between = np.array(actions, np.float32).reshape(-1, size)
        goal = self.environment.goal
        return Start(spec, np.stack(frames), between, goal, float(info["distance"]))

    def play(
        self, start: Start, begin: Callable[[Environment], Policy], steps: int
    ) -> PolicyEpisode:
        """Play one episode with a policy that looks at the simulator."""
        self.start(start.spec, start.goal)
        with noting(f"in episode {start.spec.index} of {start.spec.split}", *self._parts):
            return self._go_on(start, begin(self.environment.environment), steps)

    def replay(self, start: Start, actions: Sequence[NDArray[np.float32]]) -> list[Outcome]:
        return [
            self.play(start, lambda _, rows=rows: iter(rows).__next__, len(rows)).outcome
            for rows in actions
        ]

    def perform(self, start: Start, policy: OwnPolicy, steps: int) -> Outcome:
        return self.play_own(start, policy, steps).outcome

    def play_own(self, start: Start, policy: OwnPolicy, steps: int) -> PolicyEpisode:
        """As `perform`, with all frames and actions."""
        self.start(start.spec, start.goal)
        self._frame = start.frames[-1]
        policy.reset(start.goal)
        block: list[NDArray[np.float32]] = []

        def act() -> NDArray[np.float32]:
            if not block:
                block.extend([decision(policy, self._frame, self._estimator)] * self._stride)
            return block.pop()

        return self._go_on(start, act, steps)

    def _go_on(self, start: Start, act: Policy, steps: int) -> PolicyEpisode:
        frames: list[Frame] = []
        actions, distances, success = list[NDArray[np.float32]](), list[float](), list[bool]()
        for _ in range(steps):
            actions.append(np.asarray(act(), np.float32))
            self._frame, _, _, _, info = self.environment.step(actions[-1])
            frames.append(self._frame)
            distances.append(info["distance"])
            success.append(info["success"])
        outcome = compute_outcome(np.array(distances, np.float64), np.array(success), start)
        return PolicyEpisode(frames, np.stack(actions), outcome)


class ModelJudge(Judge):
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

    def replay(self, start: Start, actions: Sequence[NDArray[np.float32]]) -> list[Outcome]:
        """All sequences get the same noise, so they differ only in actions."""
        outcomes: list[Outcome] = []
        for first in range(0, len(actions), self.batch):
            outcomes += self._replay_batch(start, np.stack(actions[first : first + self.batch]))
        return outcomes

    def _replay_batch(self, start: Start, rows: NDArray[np.float32]) -> list[Outcome]:
        number, known = len(rows), len(start.frames)
        last = np.zeros_like(rows[:, :1])  # no frame follows it
        between = np.broadcast_to(start.actions, (number, *start.actions.shape))
        inputs = torch.from_numpy(np.concatenate([between, rows, last], 1)).to(self._device)
        given = self._given(start).expand(number, -1, -1, -1, -1)
        seeds, observations = [start.spec.index] * number, list[list[Observation]]()
        with noting(_when(start), *self._world.children()):
            chunks = self._world.rollout_chunks(given, inputs, steps=self._steps, seeds=seeds)
            for chunk in chunks:
                new = chunk[:, max(0, known) :]
                known = max(0, known - chunk.shape[1])
                if new.shape[1]:
                    observations.append([self._estimator.read(each.cpu()) for each in new])
        return [
            read_outcome(join_observations([*seen]), self._task, start)
            for seen in zip(*observations, strict=True)
        ]

    def perform(self, start: Start, policy: OwnPolicy, steps: int) -> Outcome:
        """The policy decides once per latent frame."""
        between = torch.from_numpy(start.actions)[None].to(self._device)
        stream = self._world.stream(
            self._given(start), between, steps=self._steps, seeds=[start.spec.index]
        )
        policy.reset(start.goal)
        frame, stride, observations = stream.given[0, -1], self._world.codec.temporal_stride, []
        for _ in range(0, steps, stride):
            action = decision(policy, to_pixels(frame[None])[0], self._estimator)
            rows = torch.from_numpy(np.stack([action] * stride))[None].to(self._device)
            with noting(_when(start), *self._world.children()):
                frames = stream.step(rows)[0]
            frame = frames[-1]
            observations.append(self._estimator.read(frames.cpu()))
        seen = join_observations(observations)
        states = {name: values[:steps] for name, values in seen.states.items()}
        return read_outcome(Observation(seen.masks[:steps], states), self._task, start)

    @property
    def _device(self) -> torch.device:
        return self._world.action_low.device

    def _given(self, start: Start) -> Video:
        return as_clip(start.frames)[None].to(self._device)


def _when(start: Start) -> str:
    return f"in episode {start.spec.index} of {start.spec.split}, while the model predicts"


def decision(
    policy: OwnPolicy, frame: Frame, estimator: StateEstimator | None
) -> NDArray[np.float32]:
    """The action of a policy that observes a frame, or the states read from it."""
    state = None
    if policy.observes == "state" and estimator is not None:
        seen = estimator.read(as_clip(frame[None]))
        state = {name: values[0] for name, values in seen.states.items()}
    return policy.act(frame.copy(), state)  # the policy may modify the frame
