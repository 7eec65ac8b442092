"""The simulator of a session, one frame at a time."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.simulate import make_environment
from acwm_core.env.environment import Environment, Policy
from acwm_core.env.episode import EpisodeSpec, FactorValue
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.errors import noting
from acwm_core.plugins import catalog

SCENES = 100_000
"""Number of scenes to draw from."""


@dataclass(frozen=True)
class SceneSpec:
    """The start of a world: an episode of the training split, with other factors if requested.

    Attributes:
        index: number of the episode.
        factors: values of factors by name; the episode draws the other factors.
    """

    index: int
    factors: Mapping[str, FactorValue] = field(default_factory=dict[str, FactorValue])

    @classmethod
    def draw(cls, factors: Mapping[str, FactorValue]) -> SceneSpec:
        """Draw a random scene with these factors."""
        return cls(secrets.randbelow(SCENES), factors)


@dataclass(frozen=True)
class TaskProgress:
    """How a frame stands to the goal.

    Attributes:
        distance: distance to the goal, in the task's unit.
        solved: whether the goal has been reached since it was set.
        failed: whether the task has failed, so that it cannot be solved any more.
    """

    distance: float
    solved: bool
    failed: bool


@dataclass(frozen=True)
class TimeStep:
    """Everything that the simulator knows about one frame.

    Attributes:
        frame: `[H, W, 3]` uint8.
        mask: `[H, W]` uint8 instance ids.
        state: the state fields of the card.
        contacts: pairs of instance ids that touch.
        factors: the value of every factor.
        ood_label: the factors whose values lie outside the training range, or None.
        action: the raw action `[A]` that led to this frame; zeros at the start.
        progress: how far the goal is, if there is one.
    """

    frame: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    state: Mapping[str, NDArray[Any]]
    contacts: tuple[tuple[int, int], ...]
    factors: Mapping[str, FactorValue]
    ood_label: str | None
    action: NDArray[np.float32]
    progress: TaskProgress | None = None


class Simulator:
    """A live environment.

    Args:
        environment: registered name of the environment.
        size: height and width of frames.
    """

    def __init__(self, environment: str, size: tuple[int, int]) -> None:
        self.environment: Environment = make_environment(environment, {"size": list(size)})
        self.card = self.environment.card
        self._policy: Policy | None = None
        self._spec = EpisodeSpec(self.card.name)
        self._takeovers = 0
        self._name = environment
        self._goal_drawer: Environment | None = None
        self._goals: dict[str, Goal] = {}
        self._goal_environment: TaskEnvironment | None = None
        self._solved = False

    def start(self, scene: SceneSpec, frames: int = 1) -> list[TimeStep]:
        """Build a scene and hold still for `frames` frames, as many as a model is given."""
        spec = EpisodeSpec(self.card.name, "train", scene.index, factors=dict(scene.factors))
        with noting(f"in scene {scene.index}", self.environment):
            frame, info = self.environment.reset(options={"spec": spec})
        self._spec, self._policy = spec, None
        self._goals, self._goal_environment = {}, None
        time_steps = [self._time_step(frame, info, np.zeros(self.card.action.size, np.float32))]
        return time_steps + [self.step(self.still()) for _ in range(frames - 1)]

    def step(self, action: NDArray[np.float32]) -> TimeStep:
        """Advance by one frame; the action is clipped to its bounds."""
        action_spec = self.card.action
        low, high = (np.asarray(b, np.float32) for b in (action_spec.low, action_spec.high))
        clipped = np.clip(np.nan_to_num(np.asarray(action, np.float32)), low, high)
        with noting("while playing", self.environment):
            frame, _, _, _, info = (self._goal_environment or self.environment).step(clipped)
        return self._time_step(frame, info, clipped)

    def aim(self, task: str) -> tuple[Goal, TaskProgress]:
        """Set the goal of a task in this scene; from now on, time steps say how they stand to it.

        It is drawn once per scene, in a second environment, because drawing moves things.

        Raises:
            RecipeError: the environment has no such task.
            RecipeError: the scene has no goal that is not reached at its start.
        """
        goal_task: Task = catalog().component("environment", self._name).load_task(task)
        with noting(f"in scene {self._spec.index}", self.environment):
            if task not in self._goals:
                if self._goal_drawer is None:
                    size = {"size": list(self.card.frame_size)}
                    self._goal_drawer = make_environment(self._name, size)
                drawing = TaskEnvironment(self._goal_drawer, goal_task)
                drawing.reset(options={"spec": self._spec})
                self._goals[task] = drawing.goal
            self._goal_environment = TaskEnvironment(self.environment, goal_task)
            self._solved = False
            self._goal_environment.goal = self._goals[task]
            _, info = self.environment.observe()
            self._goal_environment.judge(info)
        return self._goal_environment.goal, self._progress(info)

    def still(self) -> NDArray[np.float32]:
        """The action that means no motion."""
        return self.environment.still_action()

    def step_by_policy(self, anew: bool) -> TimeStep:
        """Advance by one frame with the behaviour policy; `anew` restarts the policy from here."""
        with noting("while its policy drives", self.environment):
            if self._policy is None or anew:
                self._takeovers += 1
                rng = self._spec.rng(f"play:{self._takeovers}")
                self._policy = self.environment.policy(rng)
            action = np.asarray(self._policy(), np.float32)
        return self.step(action)

    def close(self) -> None:
        """Free the environments' resources."""
        for environment in (self.environment, self._goal_drawer):
            if environment is not None:
                environment.close()

    def _time_step(
        self, frame: NDArray[np.uint8], info: Mapping[str, Any], action: NDArray[np.float32]
    ) -> TimeStep:
        names = ("mask", "state", "contacts", "factors", "ood_label")
        progress = self._progress(info) if self._goal_environment else None
        return TimeStep(frame, **{n: info[n] for n in names}, action=action, progress=progress)

    def _progress(self, info: Mapping[str, Any]) -> TaskProgress:
        self._solved = self._solved or info["success"]
        return TaskProgress(info["distance"], self._solved, info["failed"])
