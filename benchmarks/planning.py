"""Decisions per second of every planner with a model, and how the time is spent.

    python benchmarks/planning.py
    python benchmarks/planning.py --planner icem --cost latent --size 64

A recurrent model with random weights behind the codec `compact` plans in reacher, from its first
frame, as speed does not depend on what a model has learned. "rollouts" are the candidates of a
decision, each of `--horizon` blocks of 4 actions. The shares of the time are: `encode` real frames,
`predict` latents, `decode` and `estimate` pictures for a cost that reads states; the rest is the
planner itself. For the gradient planner, `predict` contains only the forward pass; the backward
pass is in the rest.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from acwm_core.checks.trial import shaken
from acwm_core.data.simulate import make_environment
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.evaluation.score import estimator_for
from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.run import make_cost, make_planner
from acwm_planning.settings import settings_of

PLANNERS = ("random_shooting", "cem", "icem", "mppi", "gradient")
SHARES = ("encode", "predict", "decode", "estimate")


def random_world(card: Any) -> WorldModel:
    """The untrained recurrent model of `+recurrent`."""
    torch.manual_seed(0)
    codec = catalog().create("codec", "compact")
    network = catalog().create("model", "recurrent", latent_channels=codec.channels)
    conditioner = catalog().create(
        "conditioner",
        "adaln",
        embedding="stacked",
        action_size=card.action.size,
        temporal_stride=codec.temporal_stride,
        width=network.width,
        layers=network.layers,
        heads=network.heads,
    )
    bounds = card.action.low, card.action.high
    world = WorldModel(codec, shaken(network), shaken(conditioner), Regression(), *bounds)
    return world.requires_grad_(False).eval()


class Clock:
    """Seconds by name."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time counted."""

        def call(*args: Any, **more: Any) -> Any:
            began = time.perf_counter()
            try:
                return function(*args, **more)
            finally:
                self.seconds[name] += time.perf_counter() - began

        return call


def measure(
    stage: TaskEnvironment, planner: str, cost: str, horizon: int, seconds: float
) -> list[str]:
    """A line of the table: decisions during `seconds`, after one that is not counted."""
    card = stage.environment.card
    world, clock = random_world(card), Clock()
    estimator = estimator_for(card)
    assert estimator is not None
    world.codec.encode = clock.timed("encode", world.codec.encode)
    world.codec.decode = clock.timed("decode", world.codec.decode)
    world.objective.predict = clock.timed("predict", world.objective.predict)
    estimator.estimate = clock.timed("estimate", estimator.estimate)
    settings = settings_of([f"planner={planner}", f"planner.horizon={horizon}", f"cost={cost}"])
    searching, judge = make_planner(settings), make_cost(settings)
    rollouts = ModelRollouts(world, card, estimator)
    frame, _ = stage.reset(options={"spec": EpisodeSpec(card.name)})
    history, still = History(EpisodeSpec(card.name), [frame]), stage.environment.still_action()
    bounds = world.action_low, world.action_high
    goal_cost = GoalCost(judge, stage.task, stage.goal)
    times: list[float] = []
    evaluations = 0
    while not times or sum(times[1:]) < seconds:
        if len(times) == 1:
            clock.seconds.clear()
        began = time.perf_counter()
        costs = rollouts.cost(history, still, goal_cost, 0)
        plan = searching.plan(costs, *bounds, torch.Generator().manual_seed(len(times)))
        times.append(time.perf_counter() - began)
        evaluations = plan.evaluations
    spent = sum(times[1:])
    half, most = np.percentile(times[1:], [50, 95])
    shares = [100 * clock.seconds[name] / spent for name in SHARES]
    figures = [f"{1 / half:.2f}", f"{half:.2f}", f"{most:.2f}"]
    return [planner, cost, str(evaluations), *figures, *(f"{share:.0f} %" for share in shares)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--planner", action="append", help="all if not given")
    parser.add_argument("--cost", action="append", help="latent and state if not given")
    parser.add_argument("--size", type=int, default=64, help="side of the frames")
    parser.add_argument("--horizon", type=int, default=5, help="blocks of actions")
    parser.add_argument("--seconds", type=float, default=10.0, help="per line")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    component = catalog().component("environment", "reacher")
    environment = make_environment(component, {"size": arguments.size})
    stage = TaskEnvironment(environment, component.load_task("reach"))
    heads = ("planner", "cost", "rollouts", "decisions/s", "p50 s", "p95 s", *SHARES)
    size, threads = arguments.size, arguments.threads
    table = Table(*heads, title=f"recurrent, {size}×{size}, compact, float32, {threads} threads")
    for cost in arguments.cost or ("latent", "state"):
        for planner in arguments.planner or PLANNERS:
            if (planner, cost) != ("gradient", "state"):  # which has no gradient
                table.add_row(*measure(stage, planner, cost, arguments.horizon, arguments.seconds))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
