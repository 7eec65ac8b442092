"""Drivers of which it is known what they do."""

import multiprocessing
import threading
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from acwm_core.data.simulate import make_environment
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.plugins import catalog
from acwm_play.driver import Driver
from tests.plugins import plugin_of


def solved(environment, task, index):
    """The scripted solution of a scene: its goal, the actions, and the distance in every frame."""
    made = TaskEnvironment(make_environment(environment, {"size": [64, 64]}), task)
    _, info = made.reset(options={"spec": EpisodeSpec(environment, "train", index)})
    act = task.solution(made.environment, made.goal, np.random.default_rng(0))
    actions, distances = [], [info["distance"]]
    while not info["success"]:
        actions.append(np.asarray(act(), np.float32))
        *_, info = made.step(actions[-1])
        distances.append(info["distance"])
    made.close()
    return made.goal, actions, distances


class Replay(Driver):
    """Takes the scripted solution's actions, five at a time."""

    def __init__(self, *, world_model, card, task, action_std, steps):
        self.name, self.task = card.name, task

    def begin(self, goal, still, seed):
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            # a simulator that draws needs the main thread of a process
            given, self.actions, _ = pool.submit(solved, self.name, self.task, seed).result()
        np.testing.assert_array_equal(goal.frame, given.frame)

    def act(self, frames, actions, check):
        taken, self.actions = self.actions[:5], self.actions[5:]
        return taken


class Stuck(Replay):
    """Thinks until nobody waits any more."""

    begun, stopped = threading.Event(), threading.Event()

    def begin(self, goal, still, seed):
        pass

    def act(self, frames, actions, check):
        self.begun.set()
        try:
            while True:
                time.sleep(0.01)
                check()
        finally:
            self.stopped.set()


class Throws(Stuck):
    """Knows nothing."""

    def act(self, frames, actions, check):
        raise ValueError("no idea")


def register():
    if "drivers" not in catalog().plugins:
        here = {"replay": "Replay", "stuck": "Stuck", "throws": "Throws"}
        drivers = {name: f"{__name__}:{where}" for name, where in here.items()}
        catalog().add_plugin(plugin_of(drivers=drivers), "drivers")


def plan_briefly(patch):
    """Let decisions for push_cube try a twentieth of the plans: a second instead of many."""
    task = catalog().component("environment", "push_cube").load_task("place")
    few = ("planner.candidates=64", "planner.iterations=2", "planner.elites=8")
    patch.setattr(task, "planning", (*task.planning, *few))
