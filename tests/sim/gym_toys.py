"""Toy environments of Gymnasium: a bar that slides."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete


class Slider(gymnasium.Env):
    """A bar that an action moves; it ends an episode when it leaves, and says it to nobody."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    action_space = Box(-1.0, 1.0, (1,), np.float32)
    observation_space = Dict(
        {
            "place": Box(0, 50, (1,), np.float64),
            "picture": Box(0, 255, (2, 2), np.uint8),
        }
    )

    def __init__(self, render_mode="rgb_array"):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(20, 30)
        return self.seen(), {}

    def seen(self):
        return {"place": np.array([self.place]), "picture": np.zeros((2, 2), np.uint8)}

    def step(self, action):
        self.place = float(np.clip(self.place + 3 * float(action[0]), 0, 50))
        return self.seen(), 0.0, self.place > 40, False, {}

    def render(self):
        frame = np.full((64, 96, 3), 40, np.uint8)
        covered = np.clip(self.place + 24 - np.arange(96), 0, 1) * (np.arange(96) > 10)
        frame[20:44] += (covered[:, None] * [200, 100, 50]).astype(np.uint8)
        return frame


class Chooser(Slider):
    action_space = Discrete(3)

    def step(self, action):
        assert isinstance(action, int)
        return super().step([action - 1])


class Free(Slider):
    action_space = Box(-np.inf, np.inf, (1,), np.float32)


for kind in (Slider, Chooser, Free):
    gymnasium.register(f"tests/{kind.__name__}-v0", kind)
