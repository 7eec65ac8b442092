"""`TaskScenes`: scenes with a task, as an environment of stable-baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.task import Goal, Task
from acwm_planning.policies.saved import PolicyInputs, raw_actions, side_by_side
from acwm_policy.judging import judge
from acwm_policy.scenes import Scenes, States

Observations = NDArray[np.float32]


class TaskScenes(VecEnv):
    """Parallel episodes of a task; one that ends begins again at another start.

    The reward of a step is by how much the task's distance decreases, in units of `unit`, and a
    bonus for success, which ends the episode. A failure does not end it, but nothing after it
    counts as success. An episode is truncated after the task's number of actions. Actions are
    scaled to [-1, 1].

    Args:
        scenes: the scenes.
        task: the task.
        card: card of the environment.
        inputs: what is observed.
        unit: the distance that is worth a reward of 1.
        bonus: the reward for success.
        seed: of the starts that are drawn.

    Attributes:
        random: draws the starts.
    """

    def __init__(
        self,
        scenes: Scenes,
        task: Task,
        card: EnvironmentCard,
        inputs: PolicyInputs,
        *,
        unit: float,
        bonus: float = 1.0,
        seed: int = 0,
    ) -> None:
        self._scenes, self._task, self._inputs = scenes, task, inputs
        self._unit, self._bonus, self.random = unit, bonus, np.random.default_rng(seed)
        self._low, self._high = np.array(card.action.low), np.array(card.action.high)
        number = scenes.number
        self._goals: list[Goal] = []
        self._aims = np.zeros((number, 0))
        self._now = np.zeros((number, 0))
        self._distance, self._returns = np.zeros(number), np.zeros(number)
        self._frames = np.zeros(number, np.int64)
        self._failed = np.zeros(number, np.bool_)
        self._actions = np.zeros((number, card.action.size), np.float32)
        size = card.action.size
        super().__init__(
            number,
            gymnasium.spaces.Box(-np.inf, np.inf, (inputs.size,), np.float32),
            gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32),
        )

    def reset(self) -> Observations:
        """Begin all scenes, at starts drawn at random."""
        return self.begin(self.random.integers(self._scenes.starts, size=self.num_envs).tolist())

    def begin(self, starts: Sequence[int]) -> Observations:
        """Begin all scenes, at these starts `[n]`."""
        states, goals = self._scenes.begin(range(self.num_envs), starts)
        self._goals = goals
        self._aims = self._fields_of(goals)
        self._now = side_by_side(states, self._inputs.state)
        self._fresh(np.arange(self.num_envs), states)
        return self._inputs.vectors(self._now, self._now, self._aims)

    @property
    def distances(self) -> NDArray[np.float64]:
        """The distance of each scene from its goal, `[n]`; the last one that was known."""
        return self._distance.copy()

    def step_async(self, actions: NDArray[np.floating[Any]]) -> None:
        """Take the scaled actions `[n, A]` of a step."""
        self._actions = raw_actions(actions, self._low, self._high)

    def step_wait(self) -> tuple[Observations, NDArray[np.float32], NDArray[np.bool_], list[Any]]:
        """Move all scenes; those that end begin again."""
        limit, repeat = self._task.max_steps, self._scenes.repeat
        states = self._scenes.step(self._actions)
        counted = np.minimum(repeat, limit - self._frames)
        found = judge(self._task, states, self._goals, self._distance, self._failed, counted)
        solved = found.success & ~self._failed
        rewards = (self._distance - found.distance) / self._unit + self._bonus * solved
        self._distance, self._failed = found.distance, found.failed
        self._frames, self._returns = self._frames + counted, self._returns + rewards
        late = (self._frames >= limit) & ~solved
        before, self._now = self._now, side_by_side(_last(states), self._inputs.state)
        vectors = self._inputs.vectors(self._now, before, self._aims)
        over, infos = solved | late, [dict[str, Any]() for _ in range(self.num_envs)]
        for row in np.flatnonzero(over):
            infos[row] = {
                "terminal_observation": vectors[row],
                "TimeLimit.truncated": bool(late[row]),
                "is_success": bool(solved[row]),
                "failed": bool(self._failed[row]),
                "episode": {"r": float(self._returns[row]), "l": int(self._frames[row]), "t": 0.0},
            }
        if over.any():
            vectors = self._begin_again(np.flatnonzero(over), vectors)
        return vectors, rewards.astype(np.float32), over, infos

    def _begin_again(self, rows: NDArray[np.int64], vectors: Observations) -> Observations:
        starts = self.random.integers(self._scenes.starts, size=len(rows))
        states, goals = self._scenes.begin(rows.tolist(), starts.tolist())
        for row, goal in zip(rows, goals, strict=True):
            self._goals[row] = goal
        self._aims[rows] = self._fields_of(goals)
        self._now[rows] = now = side_by_side(states, self._inputs.state)
        self._fresh(rows, states)
        vectors = vectors.copy()
        vectors[rows] = self._inputs.vectors(now, now, self._aims[rows])
        return vectors

    def _fresh(self, rows: NDArray[np.int64], states: States) -> None:
        """The distances of scenes that have just begun, with states `[k, …]`."""
        goals = [self._goals[row] for row in rows]
        one = {name: values[:, None] for name, values in states.items()}
        none, once = np.zeros(len(rows), np.bool_), np.ones(len(rows), np.int64)
        found = judge(self._task, one, goals, np.full(len(rows), self._unit), none, once)
        self._distance[rows], self._failed[rows] = found.distance, found.failed
        self._frames[rows], self._returns[rows] = 0, 0.0

    def _fields_of(self, goals: Sequence[Goal]) -> NDArray[np.float64]:
        shapes = self._inputs.goal
        fields = {name: np.stack([np.asarray(g.state[name]) for g in goals]) for name in shapes}
        return side_by_side(fields, shapes) if fields else np.zeros((len(goals), 0))

    def close(self) -> None:
        """Free all resources."""
        self._scenes.close()

    # What stable-baselines3 asks of an environment in other processes ---------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute for each scene; `AttributeError` if there is no such one."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all scenes."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *arguments: Any, indices: Any = None, **named: Any
    ) -> list[Any]:
        """Call a method, and return its result for each scene."""
        result = getattr(self, method_name)(*arguments, **named)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Scenes are not wrapped."""
        return [False for _ in self._get_indices(indices)]


def _last(states: States) -> States:
    """The states in the last video frame of a step."""
    return {name: values[:, -1] for name, values in states.items()}
