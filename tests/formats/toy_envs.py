"""Gymnasium environments for tests; ``tests.formats.toy_envs:Toy/…-v0`` imports this first."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


class Dot(gymnasium.Env):
    """A dot that moves by its action; the episode ends where it leaves the frame."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, render_mode=None, actions="box", frames="uint8"):
        self.render_mode = render_mode
        self.observation_space = Box(-100, 100, (2,), np.float64)
        self.action_space = {
            "box": Box(np.array([-2, -1], np.float32), np.array([2, 1], np.float32)),
            "discrete": Discrete(3, start=1),
            "endless": Box(-np.inf, np.inf, (2,)),
            "bits": MultiBinary(2),
        }[actions]
        self._frames = frames

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._position = self.np_random.uniform(8, 24, 2)
        return self._position.copy(), {}

    def step(self, action):
        if isinstance(self.action_space, Discrete):
            action = (int(action) - 2, 0)
        self._position = self._position + np.asarray(action)
        outside = bool(np.any(self._position < 4) or np.any(self._position > 36))
        return self._position.copy(), 0.0, outside, False, {}

    def render(self):
        frame = np.full((40, 44, 3), 50, np.uint8)
        row, column = np.clip(self._position, 0, 35).astype(int)
        frame[row : row + 4, column : column + 4] = (250, 200, 20)
        if self._frames == "broken":
            raise OSError("there is no display")
        return frame if self._frames == "uint8" else None


class Quiet(Dot):
    """Does not say how many frames a second has, and ends by its time limit."""

    metadata: ClassVar = {"render_modes": ["rgb_array"]}


def right(observation, rng):
    """Goes right at a random pace."""
    return np.array([0, rng.uniform(0.1, 1)], np.float32)


def too_far(observation, rng):
    return np.array([0, 9], np.float32)


NOTHING = 3

HERE = "tests.formats.toy_envs"
gymnasium.register("Toy/Dot-v0", f"{HERE}:Dot")
gymnasium.register("Toy/Quiet-v0", f"{HERE}:Quiet", max_episode_steps=6)
for kind in ("discrete", "endless", "bits"):
    gymnasium.register(f"Toy/{kind.title()}-v0", f"{HERE}:Dot", kwargs={"actions": kind})
gymnasium.register("Toy/Blind-v0", f"{HERE}:Dot", kwargs={"frames": "none"})
gymnasium.register("Toy/Broken-v0", f"{HERE}:Dot", kwargs={"frames": "broken"})


class Reusing(gymnasium.Env):
    """Writes observations and frames into the same arrays in every step, and so does `counting`."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    action_space = Box(-9, 99, (1,), np.float32)
    observation_space = Box(0, 99, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self._seen, self._frame = np.zeros(1, np.float32), np.zeros((16, 16, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._seen[:] = 1
        return self._seen, {}

    def step(self, action):
        self._seen += 1
        action[:] = 0
        return self._seen, 0.0, False, False, {}

    def render(self):
        self._frame[:] = int(self._seen[0])
        return self._frame


TAKEN = np.zeros(1, np.float32)


def counting(observation, rng):
    TAKEN[:] = observation
    return TAKEN


gymnasium.register("Toy/Reusing-v0", f"{HERE}:Reusing")


class Counting(gymnasium.Env):
    """Draws how often it was reset, its step and its last action; ends after 2 to 6 steps."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    action_space = Discrete(200)
    observation_space = Box(0, 99, (1,), np.float64)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode
        self._resets = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._resets += 1
        self._step, self._action = 0, 0
        self._length = int(self.np_random.integers(2, 7))
        return np.zeros(1), {}

    def step(self, action):
        self._step, self._action = self._step + 1, int(action)
        ended = self._step == self._length
        return np.full(1, self._step, float), 0.0, ended and self._length % 2 == 0, ended, {}

    def render(self):
        frame = np.zeros((16, 16, 3), np.uint8)
        frame[:] = self._resets, self._step, self._action
        return frame


gymnasium.register("Toy/Counting-v0", f"{HERE}:Counting")


class Batch(gymnasium.vector.VectorEnv):
    """Steps arrays, so it takes one seed for all; the environment i ends after i + 1 steps."""

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    single_action_space, single_observation_space = Discrete(200), Box(0, 99, (1,), np.float64)

    def __init__(self, num_envs, render_mode):
        self.num_envs, self.render_mode = num_envs, render_mode
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._steps, self._resets, self._last = np.zeros((3, self.num_envs), int)
        return self._steps[:, None].astype(float), {}

    def step(self, actions):
        again = self._steps > np.arange(self.num_envs)
        self._steps, self._last = np.where(again, 0, (self._steps + 1, actions))
        self._resets += again
        ended = self._steps > np.arange(self.num_envs)
        return self._steps[:, None].astype(float), 0.0 * ended, ended, False & ended, {}

    def render(self):
        shown = np.stack([self._resets, self._steps, self._last], -1).astype(np.uint8)
        return tuple(np.tile(each, (16, 16, 1)) for each in shown)


gymnasium.register("Toy/Batch-v0", vector_entry_point=f"{HERE}:Batch")


def several(mode, kind=gymnasium.vector.SyncVectorEnv):
    """Three of them at once."""
    return kind([lambda: Counting("rgb_array")] * 3, autoreset_mode=mode)


def same_step():
    return several("SameStep")


def next_step_in_processes():
    return several("NextStep", gymnasium.vector.AsyncVectorEnv)


def wrapped():
    """A wrapper that nothing registers."""
    return gymnasium.wrappers.TimeLimit(Counting("rgb_array"), 3)
