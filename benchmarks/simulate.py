"""Speed of the environments on one core: `python benchmarks/simulate.py [ENVIRONMENT ...]`.

For each environment at 64×64 and at its own size: frames per second of processor time, seconds per
episode, what share physics (with the behaviour policy) and rendering take, and peak memory. The
last column is frames per fixed NumPy workload (a sort), to compare machines, or busy hours.
"""

import argparse
import resource
import time

import numpy as np

from acwm_core.catalog import catalog
from acwm_core.environment import Environment
from acwm_core.episode import SPLITS, EpisodeSpec, Split


class Stopwatch:
    """Adds up the processor time spent in the functions it wraps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function):
        """The same function, timed."""

        def timed(*args):
            start = time.process_time()
            try:
                return function(*args)
            finally:
                self.seconds += time.process_time() - start

        return timed


def workload() -> float:
    """Sorts of a hundred thousand numbers per second: how fast this core is just now."""
    values = np.random.default_rng(0).normal(size=100_000)
    return 1 / float(np.median([_timed(lambda: np.sort(values)) for _ in range(50)]))


def _timed(function) -> float:
    start = time.process_time()
    function()
    return time.process_time() - start


def play(env: Environment, split: Split, index: int) -> int:
    """One episode under the behaviour policy; returns its number of frames."""
    spec = EpisodeSpec(env.card.name, split, index)
    env.reset(options={"spec": spec})
    policy = env.policy(spec.rng("policy"))
    for _ in range(env.card.horizon - 1):
        env.step(np.asarray(policy(), np.float32))
    return env.card.horizon


def measure(name: str, size: int | None, episodes: int, split: Split, unit: float) -> str:
    """One row of the table; `unit` is the core's own speed, for comparing loads."""
    env: Environment = catalog().create("environment", name, size=size)
    play(env, split, 0)  # compiles, and draws what stands still
    drawing = Stopwatch()
    env._render = drawing.wrap(env._render)
    start = time.process_time()
    frames = sum(play(env, split, index) for index in range(episodes))
    total = time.process_time() - start
    height, width = env.frame_size
    share = 100 * drawing.seconds / total
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"{name:24} {f'{height}×{width}':>9} {frames / total:9.0f} {total / episodes:10.3f} "
        f"{100 - share:8.0f} % {share:8.0f} % {memory:8.0f} {frames / total / unit:8.3f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Speed of the environments on one core.")
    parser.add_argument("environments", nargs="*", default=["push_cube"])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--split", choices=SPLITS, default="train")
    chosen = parser.parse_args()
    unit = workload()
    print(
        f"{'environment':24} {'size':>9} {'frames/s':>9} {'s/episode':>10} "
        f"{'physics':>10} {'drawing':>10} {'MB':>8} {'per sort':>8}"
    )
    for name in chosen.environments:
        for size in (64, None):
            print(measure(name, size, chosen.episodes, chosen.split, unit), flush=True)


if __name__ == "__main__":
    main()
