"""`Dreams`: parallel episodes that a world model predicts, judged by a task."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import to_pixels
from acwm_core.env.episode import Split
from acwm_core.env.physics import Observation
from acwm_core.env.state_field import StateField
from acwm_core.env.task import Goal, Task, judged
from acwm_core.errors import AcwmWarning, DataError, RecipeError, noting, suggest
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.score import estimator_for
from acwm_core.model.dynamics import Predictor
from acwm_core.model.state_stream import StateStream
from acwm_core.model.stream import Stream
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.training.run import load_run
from acwm_dream.starts import (
    DatasetStarts,
    DreamStart,
    SimulatorStarts,
    Starts,
    check_options,
    picture_start,
)
from acwm_planning.predicted import observation_of
from acwm_planning.rewards.task import RewardTask

Frames, Actions = NDArray[np.uint8], NDArray[np.float32]
States = Mapping[str, NDArray[Any]]
"""Fields of the state, by name."""


@dataclass(frozen=True)
class DreamSettings:
    """Settings of a dream.

    Attributes:
        run: run folder, or name of a trained model.
        task: task of its environment; without one, rewards are 0 and no episode ends early.
        reward: folder of a reward head of `acwm train-reward`, in place of a task.
        start: source of starts: the ``simulator`` or a ``dataset``; if there is no simulator, the
            dataset, with an `AcwmWarning`.
        data: folder of the dataset; that of the run's recipe by default.
        split: split of the dataset.
        max_steps: video frames per episode; the task's own number of actions by default.
        steps: sampling steps; the model's own number by default.
        device: device of the model.
    """

    run: str | Path
    task: str | None = None
    reward: str | Path | None = None
    start: Literal["simulator", "dataset"] = "simulator"
    data: str | Path | None = None
    split: Split = "train"
    max_steps: int | None = None
    steps: int | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.start not in ("simulator", "dataset"):
            raise RecipeError(f"start={self.start!r}: give 'simulator' or 'dataset'")
        if self.task is not None and self.reward is not None:
            raise RecipeError("give task= or reward=, not both")
        for name in ("max_steps", "steps"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < 1):
                raise RecipeError(f"{name}={value!r}: give 1 or more")


def settings_of(arguments: Mapping[str, Any]) -> DreamSettings:
    """Build the settings from keyword arguments.

    Raises:
        RecipeError: a setting does not exist, or `run` is missing.
    """
    names = [each.name for each in fields(DreamSettings)]
    for name in arguments:
        if name not in names:
            raise RecipeError(f"acwm/dream-v0 has no argument {name!r}{suggest(name, names)}")
    if "run" not in arguments:
        raise RecipeError("name the model: run='runs/mine', or a trained one's name")
    return DreamSettings(**arguments)


@dataclass
class _EpisodeState:
    """State of one of the parallel episodes."""

    goal: Goal | None = None
    distance: float = 0.0  # the last one that could be read
    failed: bool = False


@dataclass
class _Group:
    """Episodes that started together, in one stream; an episode that restarts leaves its slot."""

    stream: Stream
    carried: StateStream | None  # the same scenes in states, if a reward is of these
    members: list[int | None] = field(default_factory=list[int | None])


class StepResult(NamedTuple):
    """What n episodes show after a step, or at the start."""

    frames: Frames  # `[n, H, W, 3]`
    rewards: NDArray[np.float64]  # of the step's frames: minus their distances, or learnt rewards
    success: NDArray[np.bool_]
    failed: NDArray[np.bool_]
    distance: NDArray[np.float64]
    states: Mapping[str, NDArray[Any]]  # fields that are read or predicted, `[n, …]`


class Dreams:
    """Parallel episodes that a model predicts, in constant memory.

    A step is one latent frame: its action is held for `repeat` video frames, as with
    `gymnasium.wrappers.RepeatAction`.

    Args:
        settings: settings of the dreams.
        number: number of episodes.

    Attributes:
        card: card of the environment.
        repeat: video frames per step.
        max_steps: steps per episode.

    Raises:
        TrainingError: there is no such run.
        RecipeError: the model cannot be streamed, or there is no simulator to start from.
        RecipeError: there is no such task, or the reward is of another environment or of latents.
        DataError: no estimator can judge the task, or there is no dataset, or no reward.
    """

    def __init__(self, settings: DreamSettings, number: int) -> None:
        bundle = load_run(settings.run)
        self.card, self._settings = bundle.card, settings
        self._world = bundle.world_model.to(choose_device(settings.device))
        self._given, self.repeat = self._world.context_frames, self._world.codec.temporal_stride
        self.task, self._estimator = self._find_task(), estimator_for(self.card)
        head = self.task.head.card if isinstance(self.task, RewardTask) else None
        self._best = 0.0 if head is None else head.best
        self._carries = head is not None and _carries(self._world, head.state)
        if self.task is not None and self._estimator is None and not self._carries:
            raise DataError(
                f"no estimator reads the states of {self.card.name} from pictures, so its tasks "
                "and rewards cannot be judged: leave task= and reward= out"
            )
        frames = self.task.max_steps if self.task else self.card.horizon - 1
        self.max_steps = -(-(settings.max_steps or frames) // self.repeat)
        self._states = [_EpisodeState() for _ in range(number)]
        self._groups: list[_Group] = []
        blank = np.zeros((*self.card.frame_size, 3), np.uint8)
        try:
            self._open([picture_start(self.card, self._given, blank, None)], [0])
        except RecipeError as error:
            raise RecipeError(f"this model cannot be used as an environment: {error}") from error
        self.starts = self._make_starts(bundle.recipe.data.get("path"))

    def _find_task(self) -> Task | None:
        settings = self._settings
        if settings.reward is not None:
            return RewardTask.read(settings.reward, self.card)
        if settings.task is None:
            return None
        return catalog().component("environment", self.card.name).load_task(settings.task)

    def _make_starts(self, path: str | None) -> Starts:
        if self._settings.start == "simulator":
            if self.card.name in catalog().registry("environment"):
                return SimulatorStarts(self.card, self._given, self.task)
            text = f"{self.card.name} has no simulator here: episodes begin like those of its data"
            warnings.warn(text, AcwmWarning, stacklevel=2)
        folder = self._settings.data or path
        if folder is None:
            raise DataError("there is no dataset to start from: name one with data=")
        return DatasetStarts(EpisodeDataset(Path(folder), self._settings.split), self._given)

    def start(self, rng: np.random.Generator, options: Mapping[str, Any]) -> DreamStart:
        """Draw a start, or make one from ``{"frame": picture, "goal": Goal or picture}``.

        Raises:
            RecipeError, DataError: the requested start is not possible.
        """
        check_options(options, self.starts)
        goal = options.get("goal")
        if isinstance(goal, np.ndarray):
            goal = self._goal_of_picture(goal)
        if "frame" in options:
            start = picture_start(self.card, self._given, options["frame"], goal)
        else:
            own_options = {name: options[name] for name in self.starts.options if name in options}
            start = self.starts.draw(rng, own_options)
            start = start._replace(goal=goal or start.goal)
        if isinstance(self.task, RewardTask) and start.goal is None:
            nothing = Goal({}, np.zeros(self._shape[:2], np.uint8), start.frames[-1])
            start = start._replace(goal=nothing)
        if self.task is not None and not isinstance(start.goal, Goal):
            raise RecipeError("the task needs a goal: give one in options, a Goal or its picture")
        return start

    def _goal_of_picture(self, picture: Frames) -> Goal:
        if self._estimator is None:
            raise RecipeError("no estimator reads the goal's picture: give a Goal")
        frames = picture_start(self.card, 1, picture, None).frames
        seen = self._estimator.read(as_clip(frames))
        return Goal({n: values[0] for n, values in seen.states.items()}, seen.masks[0], picture)

    def restart(
        self, which: Sequence[int], starts: Sequence[DreamStart], seeds: Sequence[int]
    ) -> StepResult:
        """Restart some episodes, each with noise from its own seed."""
        for group in self._groups:
            group.members = [None if member in which else member for member in group.members]
        self._groups = [group for group in self._groups if {*group.members} != {None}]
        stream, carried = self._open(starts, seeds)
        self._groups.append(_Group(stream, carried, [*which]))
        for place, start in zip(which, starts, strict=True):
            self._states[place] = _EpisodeState(start.goal)
        known = None
        if carried is not None:
            known = {name: values[:, None] for name, values in _as_arrays(carried.current).items()}
        frames = to_pixels(stream.given[:, -1:].flatten(0, 1))[:, None]
        return self._judge_frames(which, frames, known)

    def step(self, which: Sequence[int], actions: NDArray[np.float32]) -> StepResult:
        """Advance some episodes, given in ascending order, with raw actions `[n, A]`.

        Raises:
            ShapeError: the actions have the wrong size, are not finite, or are out of bounds.
        """
        by_episode = dict(zip(which, actions, strict=True))
        frames: dict[int, Frames] = {}
        states: dict[int, States] = {}
        for group in self._groups:
            if not by_episode.keys() & {*group.members}:
                continue
            # for slots that are no longer used
            spare = np.array(self.card.action.low, np.float32)
            rows = np.stack([by_episode.get(-1 if m is None else m, spare) for m in group.members])
            inputs = torch.from_numpy(rows)[:, None].expand(-1, self.repeat, -1)
            with noting("while the model predicts", *self._world.children()):
                inputs = inputs.to(self._world.action_low.device)
                video = group.stream.step(inputs)
                known = {} if group.carried is None else _as_arrays(group.carried.step(inputs))
            pixels = to_pixels(video.flatten(0, 1)).reshape(*video.shape[:2], *self._shape)
            for row, member in enumerate(group.members):
                if member in by_episode:
                    frames[member] = pixels[row]
                    states[member] = {name: values[row] for name, values in known.items()}
        each = [states[place] for place in which]
        carried = {name: np.stack([one[name] for one in each]) for name in each[0]} or None
        return self._judge_frames(which, np.stack([frames[place] for place in which]), carried)

    @property
    def _shape(self) -> tuple[int, int, int]:
        return (*self.card.frame_size, 3)

    def _open(
        self, starts: Sequence[DreamStart], seeds: Sequence[int]
    ) -> tuple[Stream, StateStream | None]:
        device = self._world.action_low.device
        video = torch.stack([as_clip(start.frames) for start in starts]).to(device)
        between = torch.from_numpy(np.stack([start.actions for start in starts])).to(device)
        with noting("when the model begins", *self._world.children()):
            stream = self._world.stream(video, between, steps=self._settings.steps, seeds=seeds)
            carried = None
            if self._carries:
                carried = self._world.stream_states(video, between, seeds=seeds)
            return stream, carried

    def _judge_frames(
        self, which: Sequence[int], frames: Frames, carried: States | None = None
    ) -> StepResult:
        """Judge frames `[n, T, H, W, 3]` by the task; a reward sums distances up to success.

        What the model says of their states, `[n, T, …]`, takes the place of what is read in them.
        """
        number, length = frames.shape[:2]
        rewards, distance, success = np.zeros(number), np.zeros(number), np.zeros(number, np.bool_)
        states, masks = carried or {}, None
        if carried is None and self._estimator is not None:
            seen = self._estimator.read(as_clip(frames.reshape(-1, *self._shape)))
            states = {n: v.reshape(number, length, *v.shape[1:]) for n, v in seen.states.items()}
            masks = seen.masks.reshape(number, length, *seen.masks.shape[1:])
        for row, state in enumerate(self._states[k] for k in which):
            if self.task is None or state.goal is None:
                continue
            own = {n: v[row] for n, v in states.items()}
            shown = observation_of(own, length) if masks is None else Observation(masks[row], own)
            success[row], rewards[row] = _judge_episode(self.task, shown, state, self._best)
            distance[row] = state.distance
        failed = np.array([self._states[k].failed for k in which])
        last = {name: values[:, -1] for name, values in states.items()}
        return StepResult(frames[:, -1], rewards, success, failed, distance, last)


def _carries(world: WorldModel, fields: Sequence[StateField]) -> bool:
    """Whether a model carries all these fields of the state from frame to frame."""
    able = isinstance(world.model, Predictor) and world.model.implements("carry_states")
    return able and {field.name for field in fields} <= {*world.state_shapes}


def _as_arrays(fields: Mapping[str, Tensor]) -> States:
    return {name: values.cpu().numpy() for name, values in fields.items()}


def spaces_of(dreams: Dreams) -> tuple[gymnasium.Space[Frames], gymnasium.Space[Actions]]:
    """The observation space and the action space of one episode."""
    action = dreams.card.action
    low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
    return (
        gymnasium.spaces.Box(0, 255, (*dreams.card.frame_size, 3), np.uint8),
        gymnasium.spaces.Box(low, high, dtype=np.float32),
    )


def _judge_episode(
    task: Task, seen: Observation, state: _EpisodeState, best: float
) -> tuple[bool, float]:
    """Whether a step succeeds, and the sum up to then of by how much distances are below `best`."""
    assert state.goal is not None
    reward, names = 0.0, ("distance", "success", "failed")
    judgements = (judged(task, name, seen, state.goal) for name in names)
    for distance, solved, failed in zip(*judgements, strict=True):
        state.distance = float(distance) if np.isfinite(distance) else state.distance
        state.failed = state.failed or bool(failed)
        reward += best - state.distance
        if solved and not state.failed:
            return True, reward
    return False, reward
