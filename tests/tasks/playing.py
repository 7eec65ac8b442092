"""Tasks at 64 pixels, and their solutions."""

import numpy as np

from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.physics import Observation
from acwm_core.env.task import TaskEnvironment
from acwm_core.plugins import catalog

SEED = 5


def make(environment, task):
    component = catalog().component("environment", environment)
    return TaskEnvironment(component.create(size=64), component.load_task(task))


def spec_of(env, index=0):
    return EpisodeSpec(env.environment.card.name, "ind_test", index, SEED)


def begin(env, index=0):
    return env.reset(options={"spec": spec_of(env, index)})


def solve(env, index=0):
    """The infos of an episode of the solution, the first that of `reset`."""
    infos = [begin(env, index)[1]]
    act = env.task.solution(env.environment, env.goal, spec_of(env, index).rng("solution"))
    over = False
    while not over:
        _, reward, success, truncated, info = env.step(np.asarray(act(), np.float32))
        assert reward == -info["distance"]
        infos.append(info)
        over = success or truncated
    return infos


def seen(**states):
    """An observation of frames with these states alone; it has no masks to speak of."""
    (frames,) = {len(values) for values in states.values()}
    return Observation(np.zeros((frames, 8, 8), np.uint8), states)


def like(goal, frames=1, **states):
    """An observation of the goal in every frame, but for some fields."""
    kept = {name: np.repeat(values[None], frames, 0) for name, values in goal.state.items()}
    return Observation(np.repeat(goal.mask[None], frames, 0), kept | states)
