"""Problems whose answers are known, and the planners that are tried on them."""

import torch

from acwm_planning.gradient import Gradient
from acwm_planning.sampling import (
    CrossEntropy,
    ImprovedCrossEntropy,
    PathIntegral,
    RandomShooting,
)

PLANNERS = {
    "random_shooting": RandomShooting,
    "cem": CrossEntropy,
    "icem": ImprovedCrossEntropy,
    "mppi": PathIntegral,
    "gradient": Gradient,
}

LOW, HIGH = torch.tensor([-3.0, 0.0]), torch.tensor([1.0, 2.0])

STEP = 0.1
"""Seconds between two forces on the double integrator."""


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def planned(planner, cost, low=LOW, high=HIGH, seed=0):
    return planner.plan(cost, low, high, rng(seed))


def quadratic(target):
    return lambda actions: (actions - target).square().sum((1, 2))


def integrator_cost(start, horizon, effort=0.01):
    """What forces `[N, horizon, 1]` cost a unit mass at `start`, a place and a speed."""

    def cost(forces):
        place = start[0].expand(len(forces))
        speed = start[1].expand(len(forces))
        total = torch.zeros(len(forces))
        for force in forces[:, :horizon, 0].unbind(1):
            place, speed = place + STEP * speed, speed + STEP * force
            total = total + place**2 + 0.1 * speed**2 + effort * force**2
        return total

    return cost


def riccati(start, horizon, effort=0.01):
    """The least such cost, by dynamic programming backwards (Riccati), and its forces."""
    step = torch.tensor([[1.0, STEP], [0.0, 1.0]], dtype=torch.float64)
    push = torch.tensor([[0.0], [STEP]], dtype=torch.float64)
    weight = torch.diag(torch.tensor([1.0, 0.1], dtype=torch.float64))
    value, gains = torch.zeros(2, 2, dtype=torch.float64), []
    for _ in range(horizon):
        ahead = weight + value  # the next state is paid for when it is reached
        scale = effort + push.T @ ahead @ push
        gains.append(torch.linalg.solve(scale, push.T @ ahead @ step))
        value = step.T @ ahead @ step - step.T @ ahead @ push @ gains[-1]
    state, forces = start.double()[:, None], []
    least = float(state.T @ value @ state)
    for gain in reversed(gains):
        forces.append(-gain @ state)
        state = step @ state + push @ forces[-1]
    return least, torch.cat(forces).float()


def rippled(actions):
    """A broad bowl with ripples: many valleys, the deepest at 0.6 in each dimension."""
    away = actions - 0.6
    return (away.square() + 0.3 * (1 - torch.cos(12 * away))).sum((1, 2))
