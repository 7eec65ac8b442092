"""Planners on problems with known answers, and against each other."""

import math

import numpy as np
import pytest
import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_planning.planner import Planner
from acwm_planning.sampling import coloured_noise, path_weights
from acwm_planning.settings import settings_of
from tests.planning.problems import (
    HIGH,
    LOW,
    PLANNERS,
    integrator_cost,
    planned,
    quadratic,
    riccati,
    rippled,
    rng,
)

every_planner = pytest.mark.parametrize("name", PLANNERS)
searching = pytest.mark.parametrize("name", ["cem", "icem", "mppi", "gradient"])

THOROUGH = {
    "cem": {"candidates": 300, "iterations": 20, "elites": 30},
    "icem": {"candidates": 300, "iterations": 20, "elites": 30},
    "mppi": {"candidates": 400, "iterations": 40, "spread": 0.15, "temperature": 0.05},
    "gradient": {"candidates": 4, "iterations": 200, "learning_rate": 0.03},
}


@searching
def test_finds_the_least_of_a_quadratic(name):
    target = torch.tensor([0.5, 0.4])
    plan = planned(PLANNERS[name](horizon=2, action_block=2, **THOROUGH[name]), quadratic(target))
    assert plan.actions.shape == (4, 2)
    torch.testing.assert_close(plan.actions, target.expand(4, 2), atol=0.12, rtol=0)


@searching
def test_finds_the_edge_where_the_least_lies_outside(name):
    target = torch.tensor([5.0, -1.0])  # beyond the upper bound, and beyond the lower one
    plan = planned(PLANNERS[name](horizon=2, **THOROUGH[name]), quadratic(target))
    edge = torch.tensor([1.0, 0.0]).expand(8, 2)
    torch.testing.assert_close(plan.actions, edge, atol=0.02, rtol=0)


@searching
def test_is_as_good_as_the_linear_quadratic_regulator(name):
    start, horizon = torch.tensor([0.3, 0.0]), 8
    least, forces = riccati(start, horizon)
    cost = integrator_cost(start, horizon)
    assert float(cost(forces[None])[0]) == pytest.approx(least, rel=1e-4)
    assert forces.abs().max() < 5  # so that the bounds do not matter
    planner = PLANNERS[name](horizon=horizon, action_block=1, **THOROUGH[name])
    plan = planned(planner, cost, torch.tensor([-5.0]), torch.tensor([5.0]))
    assert least - 1e-5 <= plan.cost <= 1.01 * least
    assert plan.cost == pytest.approx(float(cost(plan.actions[None])[0]), rel=1e-5)


def test_sampling_finds_the_deepest_valley_more_often_than_one_descent():
    bounds = torch.tensor([-1.0]), torch.tensor([1.0])

    def found(planner):
        plans = [planned(planner, rippled, *bounds, seed=seed) for seed in range(20)]
        return sum(bool((plan.actions - 0.6).abs().max() < 0.1) for plan in plans)

    few = {"horizon": 2, "action_block": 1}
    descents = found(PLANNERS["gradient"](candidates=1, warm_start=False, **few))
    for name in ("cem", "icem", "mppi"):
        assert found(PLANNERS[name](warm_start=False, **few)) > max(descents, 15)
    more = found(PLANNERS["gradient"](candidates=32, spread=1.0, warm_start=False, **few))
    assert more > descents


def test_iterations_are_worth_more_than_as_many_random_candidates():
    cost, costs = quadratic(torch.tensor([0.5, 0.4])), {}
    for name in ("cem", "icem", "mppi"):
        plan = planned(PLANNERS[name](candidates=100, iterations=10), cost)
        assert plan.evaluations <= 1001
        costs[name] = plan.cost
    random = planned(PLANNERS["random_shooting"](candidates=1001), cost)
    assert random.evaluations == 1001
    assert all(found < 0.5 * random.cost for found in costs.values())


@every_planner
def test_the_same_seed_makes_the_same_plan(name):
    first, again, other = (planned(PLANNERS[name](), rippled, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.actions, again.actions)
    assert first.cost == again.cost
    assert not torch.equal(first.actions, other.actions)


@every_planner
def test_no_candidate_leaves_the_bounds(name):
    asked = []

    def cost(actions):
        asked.append(actions.detach().clone())
        return -actions.square().sum((1, 2))  # the further out, the better

    planner = PLANNERS[name](horizon=3)
    for seed in range(3):
        plan = planned(planner, cost, seed=seed)
        asked.append(plan.actions[None])
    assert all(bool(((each >= LOW) & (each <= HIGH)).all()) for each in asked)
    blocks = asked[-1].unflatten(1, (3, 4))
    assert torch.equal(blocks, blocks[:, :, :1].expand_as(blocks))


@every_planner
def test_linear_blocks_lead_from_rest_through_their_actions(name):
    rest = torch.tensor([0.5, -0.5])
    planner = PLANNERS[name](horizon=3, action_block=4, interpolation="linear")
    planner.search_near(rest, None)
    actions = planned(planner, rippled).actions
    knots = torch.cat([(LOW + (rest + 1) / 2 * (HIGH - LOW))[None], actions[3::4]])
    line = np.stack(
        [np.interp(np.arange(1, 13), [0, 4, 8, 12], knots[:, axis]) for axis in (0, 1)], -1
    )
    np.testing.assert_allclose(actions, line, atol=1e-5)


def test_an_unknown_interpolation_is_refused():
    with pytest.raises(RecipeError, match=r"planner.interpolation=cubic.*hold.*linear"):
        settings_of(["planner.interpolation=cubic"])


@every_planner
def test_what_costs_nan_is_never_chosen(name):
    def cost(actions):
        usual = (actions - LOW).square().sum((1, 2))  # least at the lower bounds,
        return torch.where(actions[:, 0, 0] < -1, math.nan, usual)  # which cannot be judged

    plan = planned(PLANNERS[name](), cost)
    assert math.isfinite(plan.cost)
    assert float(plan.actions[0, 0]) >= -1


@every_planner
def test_no_cost_at_all_is_an_error(name):
    for nothing in (math.nan, math.inf):
        with pytest.raises(RecipeError, match="no candidate has a finite cost"):
            planned(PLANNERS[name](), lambda a, n=nothing: a.sum((1, 2)) * 0 + n)


def test_a_cost_of_another_shape_is_refused():
    with pytest.raises(ShapeError, match=r"cost of 1024 candidates is \[\]"):
        planned(PLANNERS["random_shooting"](), lambda actions: actions.sum())


def test_a_cost_without_a_gradient_is_refused():
    with pytest.raises(RecipeError, match="planner=gradient needs a cost that is differentiable"):
        planned(PLANNERS["gradient"](), lambda actions: actions.detach().sum((1, 2)))


@pytest.mark.parametrize("name", ["icem", "mppi", "gradient"])
def test_a_decision_begins_from_what_is_left_of_the_last(name):
    """Of a plan whose parts differ, after the first two of its blocks were taken."""
    parts = torch.tensor([-0.8, -0.4, 0.2, 0.9]).repeat_interleave(4)[:, None]
    ahead = torch.tensor([0.2, 0.9, 0.9, 0.9]).repeat_interleave(4)[:, None]
    bounds = torch.tensor([-1.0]), torch.tensor([1.0])
    planner = PLANNERS[name](horizon=4, actions_per_plan=8, **THOROUGH[name])
    planned(planner, quadratic(parts), *bounds)
    asked = []

    def cost(actions):
        asked.append(actions.detach().clone())
        return quadratic(ahead)(actions)

    planned(planner, cost, *bounds)
    warm = float(quadratic(ahead)(asked[0]).min())
    planner.reset()
    asked.clear()
    planned(planner, cost, *bounds)
    assert warm < 0.5 < float(quadratic(ahead)(asked[0][:1]))


def test_noise_has_the_colour_that_was_asked_for():
    """Unit variance everywhere, and power that falls with the square of the frequency."""
    noise = coloured_noise((4000, 32, 2), 2.0, rng())
    torch.testing.assert_close(noise.var(0), torch.ones(32, 2), atol=0.1, rtol=0)
    power = torch.fft.rfft(noise, dim=1).abs().square().mean((0, 2))
    slope = torch.log(power[8] / power[2]) / math.log(8 / 2)
    assert float(slope) == pytest.approx(-2, abs=0.1)
    white = coloured_noise((4000, 5, 2), 0.0, rng())
    correlation = torch.corrcoef(white[:, :, 0].T) - torch.eye(5)
    assert correlation.abs().max() < 0.06
    assert coloured_noise((3, 1, 2), 2.0, rng()).shape == (3, 1, 2)


def test_weights_of_mppi_are_those_of_a_boltzmann_distribution():
    costs = torch.tensor([1.0, 2.0, 4.0, math.inf])
    scale = 0.5 * costs[:3].std(correction=0)
    wanted = torch.exp(-costs / scale) / torch.exp(-costs / scale).sum()
    torch.testing.assert_close(path_weights(costs, 0.5), wanted)
    equal = path_weights(torch.full((4,), math.inf), 0.5)
    torch.testing.assert_close(equal, torch.full((4,), 0.25))


def test_icem_draws_fewer_and_keeps_the_best():
    sizes = []

    def cost(actions):
        sizes.append(len(actions))
        return quadratic(torch.tensor([0.5, 0.4]))(actions)

    planned(PLANNERS["icem"](candidates=100, iterations=4, elites=10, decay=2.0, kept=0.3), cost)
    assert sizes == [100, 50 + 3, 25 + 3, 20 + 3 + 1]  # never fewer than twice the elites


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("cem", {"horizon": 0}, "planner.horizon=0: give 1 or more"),
        ("cem", {"candidates": 4}, "planner.candidates=4: give at least planner.elites=16"),
        ("cem", {"actions_per_plan": 21}, "give 1 to the 20 actions"),
        ("cem", {"momentum": 1.0}, "planner.momentum=1.0"),
        ("cem", {"spread": math.nan}, "planner.spread=nan"),
        ("icem", {"kept": 2.0}, "planner.kept=2.0: give a share"),
        ("icem", {"decay": 0.5}, "planner.decay=0.5"),
        ("mppi", {"temperature": 0.0}, "planner.temperature=0.0"),
        ("gradient", {"iterations": 0}, "planner.iterations=0"),
        ("random_shooting", {"candidates": 0}, "planner.candidates=0"),
    ],
)
def test_impossible_parameters_are_refused(name, params, message):
    with pytest.raises(RecipeError, match=message):
        PLANNERS[name](**params)


def test_all_are_registered():
    from acwm_core.plugins import catalog

    assert {each.name for each in catalog().registry("planner")} >= PLANNERS.keys()
    for name, kind in PLANNERS.items():
        assert type(catalog().component("planner", name).create_as(Planner)) is kind


def test_a_search_begins_near_what_it_is_told():
    """At no motion, as wide in each dimension as the actions that a model knows."""
    asked = []

    def cost(actions):
        asked.append(actions)
        return actions.square().sum((1, 2))

    once = {"candidates": 4000, "iterations": 1, "horizon": 2, "action_block": 1}
    planner = PLANNERS["cem"](**once, spread=None)
    planner.search_near(torch.tensor([0.5, -0.2]), torch.tensor([0.1, 0.3]))
    planned(planner, cost)
    blocks = (asked[0][:-1] - LOW) / (HIGH - LOW) * 2 - 1  # all but the mean of those drawn
    for block in blocks.unbind(1):
        torch.testing.assert_close(block.mean(0), torch.tensor([0.5, -0.2]), atol=0.03, rtol=0)
        torch.testing.assert_close(block.std(0), torch.tensor([0.1, 0.3]), atol=0.02, rtol=0)
    told = PLANNERS["cem"](**once, spread=0.2)
    told.search_near(torch.zeros(2), torch.tensor([0.1, 0.3]))
    planned(told, cost)
    blocks = (asked[1][:-1] - LOW) / (HIGH - LOW) * 2 - 1
    assert blocks.std((0, 1)).tolist() == pytest.approx([0.2, 0.2], abs=0.02)


def test_what_never_varied_is_still_searched_a_little():
    planner = PLANNERS["icem"](candidates=64, iterations=3, elites=8, spread=None)
    planner.search_near(torch.zeros(2), torch.zeros(2))
    plan = planned(planner, quadratic(torch.tensor([-1.0, 1.1])))
    assert plan.cost < 0.9 * 20 * 0.1**2  # than the middle of the bounds costs
