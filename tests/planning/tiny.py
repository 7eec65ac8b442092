"""A square that slides to a place, exactly simulated, and a run whose model knows nothing of it."""

from dataclasses import replace

import numpy as np
from torch import nn

from acwm_core.data.generate import generate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.plugins import catalog, hookimpl
from tests.evaluation import tiny

HERE = __name__


class Slide(tiny.Drift):
    """The square of the tiny evaluations, under another name."""

    card = replace(tiny.Drift.card, name="slide", summary="a square that slides")


class ToPlace(Task):
    """The square at a place."""

    name, summary, unit = "place", "the square within 1.5 px of its place", "px"
    tolerance, max_steps = 1.5, 12

    def sample_goal(self, environment, rng):
        corners = np.array([[0.0, 0.0], [0.0, 24.0], [24.0, 0.0], [24.0, 24.0]])
        environment._position = corners[rng.integers(4)] * 0.7
        return Goal.now(environment)

    def distance(self, seen, goal):
        return np.linalg.norm(seen.states["position"] - goal.state["position"], axis=-1)

    def solution(self, environment, goal, rng):
        return lambda: np.clip(goal.state["position"] - environment._position, -2, 2)


class Shy(ToPlace):
    """The same, but the left half of the world is forbidden, and nobody solves it."""

    name = "shy"

    def failed(self, seen, goal):
        return seen.states["position"][:, 1] < 12

    def solution(self, environment, goal, rng):
        return None


PLACE, SHY = ToPlace(), Shy()


class SquareEstimator(StateEstimator):
    """Where the brightest block of pixels begins."""

    fields = ("position",)
    instances = ("square",)

    @property
    def physics(self):
        return Physics()

    def estimate(self, video):
        sums = nn.functional.avg_pool2d(video[:, :1], tiny.SIDE, 1)[:, 0]
        best = sums.flatten(1).argmax(1)
        corner = np.stack([best // sums.shape[2], best % sums.shape[2]], 1).astype(float)
        return Observation(np.zeros((len(video), *video.shape[2:]), np.uint8), {"position": corner})

    def pixels(self, field, values):
        return values


class Plugin:
    @staticmethod
    @hookimpl
    def register_environments(registry):
        tasks = {"place": f"{HERE}:PLACE", "shy": f"{HERE}:SHY"}
        registry.add("slide", f"{HERE}:Slide", tasks=tasks)

    @staticmethod
    @hookimpl
    def register_estimators(registry):
        registry.add("slide", f"{HERE}:SquareEstimator")


def register():
    tiny.register()
    if "tiny_planning" not in catalog().plugins:
        catalog().add_plugin(Plugin, "tiny_planning")


def make_run(folder, episodes=1, parts=None):
    """A run with random weights, and data that it might have been trained on."""
    data = folder / "data"
    generate("slide", data, episodes={"train": episodes}, workers=0, progress=False)
    return tiny.make_run(folder / "run", data, parts={"env": {"name": "slide"}} | (parts or {}))


def environment(task=PLACE):
    return TaskEnvironment(Slide(), task)


def spec(seed):
    return EpisodeSpec("slide", "ind_test", seed)
