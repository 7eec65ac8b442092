"""The cost landscape of a moment, as a planner sees it in the model, and in the simulator.

Candidates are the scripted solution's next actions, all moved by the same amount in two of their
dimensions. So the solution itself is one point of the landscape, where the simulator's is low.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec
from acwm_core.errors import RecipeError
from acwm_core.files import writing, written_whole
from acwm_planning.controllers import PlanningController, PolicyController
from acwm_planning.episode import play, spec_of_seed, start_of
from acwm_planning.futures import GoalCost, History
from acwm_planning.run import EpisodePlayer, make_planner

MOMENT = 12
"""Actions of the solution before the moment, so that things move."""

SIDE = 15
"""Points of the grid along each of the two actions."""

JUDGES = ("simulator", "model")


@dataclass(frozen=True)
class Landscape:
    """Costs over a grid of two actions.

    Attributes:
        actions: index of each of the two in the action.
        values: the grid along each of them, `[2, SIDE]`; means over the plan.
        true: the solution's values of the two.
        costs: by judge, `[SIDE, SIDE]`, of the first action down and of the second across.
        ranks: by judge, the share of the grid that is cheaper than the solution.
    """

    actions: tuple[int, int]
    values: NDArray[np.float64]
    true: tuple[float, float]
    costs: Mapping[str, NDArray[np.float64]]
    ranks: Mapping[str, float]


def landscape(player: EpisodePlayer, seed: int) -> Landscape:
    """The landscape of an episode, `MOMENT` actions after its start.

    Raises:
        NoSolutionError: the task has no scripted solution.
        RecipeError: the environment has a single action.
    """
    if player.card.action.size < 2:
        raise RecipeError(f"{player.card.name} has one action, but a landscape needs two")
    history, true, still = _solved_so_far(player, seed)
    spec, environment = player.card.action, player.environment
    candidates, chosen, values = _candidates(true, spec)
    goal_cost = GoalCost(player.cost, environment.task, environment.goal)
    costs: dict[str, NDArray[np.float64]] = {}
    ranks: dict[str, float] = {}
    for judge in JUDGES:
        controller = player.controller(judge)
        assert isinstance(controller, PlanningController)
        cost = controller.rollouts.cost(history, still, goal_cost, seed)
        with torch.no_grad():
            plan_costs = cost(torch.from_numpy(candidates)).double().numpy()
        costs[judge] = plan_costs[:-1].reshape(SIDE, SIDE)
        ranks[judge] = float(np.mean(plan_costs[:-1] < plan_costs[-1]))
    means = true.mean(0)
    return Landscape(chosen, values, (means[chosen[0]], means[chosen[1]]), costs, ranks)


def _solved_so_far(
    player: EpisodePlayer, seed: int
) -> tuple[History, NDArray[np.float32], NDArray[np.float32]]:
    """The history up to the moment, the solution's next actions `[T, A]`, and the still action."""
    environment, planner = player.environment, make_planner(player.settings)
    spec = spec_of_seed(player.card, seed)
    start_of(environment, spec)
    still = environment.environment.still_action()
    ahead = getattr(planner, "horizon", 1) * getattr(planner, "action_block", 1)
    steps = MOMENT + max(ahead, planner.actions_per_plan)
    solution = play(environment, spec, PolicyController.scripted(solves=True), steps=steps)
    frames = solution.history.frames[: MOMENT + 1]
    history = History(spec, frames, solution.history.actions[:MOMENT])
    return history, solution.actions[MOMENT:], still


def _candidates(
    true: NDArray[np.float32], spec: ActionSpec
) -> tuple[NDArray[np.float32], tuple[int, int], NDArray[np.float64]]:
    """The grid's plans and, last, the solution, `[N, T, A]`; the two actions, and their values."""
    low, high = np.array(spec.low), np.array(spec.high)
    used = np.abs(true - (low + high) / 2).mean(0) / (high - low)
    first, second = sorted(np.argsort(-used, kind="stable")[:2].tolist())
    values = np.linspace(low[[first, second]], high[[first, second]], SIDE, axis=1)
    plans: list[NDArray[np.float32]] = []
    for row in values[0]:
        for column in values[1]:
            moved = true.astype(np.float64)
            moved[:, second] += column - true[:, second].mean()
            moved[:, first] += row - true[:, first].mean()
            plans.append(np.clip(moved, low, high).astype(np.float32))
    return np.stack([*plans, true]), (first, second), values


def draw(shape: Landscape, spec: ActionSpec, path: Path) -> Path:
    """Draw the landscapes side by side as a PNG, with the true action and each one's cheapest."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    axes = figure.subplots(1, len(JUDGES), sharex=True, sharey=True)
    rows, columns = shape.values
    down, across = (f"{spec.names[i]} ({spec.units[i]})".removesuffix(" ()") for i in shape.actions)
    for axis, judge in zip(axes, JUDGES, strict=True):
        costs = shape.costs[judge]
        contours = axis.contourf(columns, rows, costs, 24, cmap="viridis_r")
        figure.colorbar(contours, ax=axis, label="cost")
        best = np.unravel_index(np.nanargmin(costs), costs.shape)
        axis.plot(columns[best[1]], rows[best[0]], "x", color="white", ms=9, mew=2)
        axis.plot(shape.true[1], shape.true[0], "o", mfc="none", color="red", ms=12, mew=2)
        axis.set(title=f"{judge}: {shape.ranks[judge]:.1%} cheaper than the true one")
        axis.set(xlabel=across)
    axes[0].set(ylabel=down)
    figure.suptitle("Cost of plans by their mean action: ○ the true one, × the cheapest here")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as partial:
            figure.savefig(partial, format="png", dpi=110)
    return path
