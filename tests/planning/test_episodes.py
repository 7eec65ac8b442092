"""Episodes in the true simulator: who plans in it gets there, and who does nothing does not."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.data.simulate import simulate
from acwm_core.errors import RecipeError
from acwm_planning.controllers import (
    PlanningController,
    PolicyController,
    RandomController,
    StillController,
)
from acwm_planning.costs import StateDistance
from acwm_planning.episode import TaskVariant, play
from acwm_planning.futures import History
from acwm_planning.sampling import CrossEntropy, ImprovedCrossEntropy
from acwm_planning.scripts import NoSolutionError
from acwm_planning.simulator import SimulatorFutures, SimulatorRollouts
from tests import tiny

SMALL = {"candidates": 24, "iterations": 3, "elites": 4, "horizon": 4, "action_block": 2}


def planner(kind=ImprovedCrossEntropy, seed=0, task=tiny.PLACE, **params):
    rollouts = SimulatorRollouts(tiny.Slide(), stride=2)
    return PlanningController(
        kind(**{**SMALL, **params}), rollouts, StateDistance(frames=None), seed
    )


def played(controller, seed, task=tiny.PLACE):
    return play(tiny.task_environment(task), tiny.spec(seed), controller)


def test_planning_in_the_simulator_gets_there_and_doing_nothing_does_not():
    planned = [played(planner(), seed) for seed in range(6)]
    nothing = [played(StillController(), seed) for seed in range(6)]
    assert [each.success for each in planned] == [True] * 6
    assert [each.success for each in nothing] == [False] * 6
    for plan, still in zip(planned, nothing, strict=True):
        assert plan.distances[0] == still.distances[0] > tiny.PLACE.tolerance
        assert plan.distances[-1] <= tiny.PLACE.tolerance
        assert still.distances[-1] == still.distances[0]


@pytest.mark.slow
def test_planning_in_the_simulator_solves_reacher_far_more_often_than_doing_nothing():
    pytest.importorskip("mujoco")
    pytest.importorskip("taichi")
    from acwm_core.data.simulate import make_environment
    from acwm_core.env.episode import EpisodeSpec
    from acwm_core.env.task import TaskEnvironment
    from acwm_core.plugins import catalog

    def unseen():  # rendering takes most of the time, and the task does not look
        environment = make_environment("reacher", {"size": 16})
        picture = np.zeros((16, 16, 3), np.uint8), np.zeros((16, 16), np.uint8)
        environment._render = lambda: picture
        return environment

    task = catalog().component("environment", "reacher").load_task("reach")
    stage, rollouts = TaskEnvironment(unseen(), task), SimulatorRollouts(unseen(), 4)
    search = ImprovedCrossEntropy(candidates=48, iterations=4, elites=8, horizon=4)
    wins = {"planned": 0, "still": 0}
    for seed in range(4):
        spec = EpisodeSpec("reacher", "ind_test", seed, options={"size": (16, 16)})
        wins["planned"] += play(
            stage, spec, PlanningController(search, rollouts, StateDistance(frames=None))
        ).success
        wins["still"] += play(stage, spec, StillController()).success
    assert wins["planned"] >= 3
    assert wins["still"] == 0


def test_an_episode_can_be_played_again():
    first, again, other = (played(planner(seed=seed), 0) for seed in (0, 0, 1))
    assert np.array_equal(first.history.actions, again.history.actions)
    assert first.distances == again.distances
    assert not np.array_equal(first.history.actions, other.history.actions)
    # an instance that has planned before does not remember it
    controller = planner()
    played(controller, 1)
    assert np.array_equal(played(controller, 0).history.actions, first.history.actions)


@pytest.mark.parametrize("kind", ["delta", "absolute"])
def test_a_planner_is_told_what_no_motion_is(kind, monkeypatch):
    """Where actions are places, that is the place that was asked for last."""
    asked = []

    class Told(ImprovedCrossEntropy):
        def search_near(self, still, action_std):
            asked.append((still, action_std))
            super().search_near(still, action_std)

    card = replace(tiny.Slide.card, action=replace(tiny.Slide.card.action, kind=kind))
    monkeypatch.setattr(tiny.Slide, "card", card)
    rollouts = SimulatorRollouts(tiny.Slide(), stride=2)
    controller = PlanningController(Told(**SMALL), rollouts, StateDistance(), action_std=[0.5, 1.0])
    taken = np.stack(played(controller, 0).history.actions)
    assert len(asked) == len(controller.decisions) > 2
    high = np.array(card.action.high)
    for decision, (still, action_std) in zip(controller.decisions, asked, strict=True):
        moved = kind == "absolute" and decision.frame
        expected = taken[decision.frame - 1] / high if moved else np.zeros(2)
        np.testing.assert_allclose(still.numpy(), expected, atol=1e-6)
        np.testing.assert_allclose(action_std.numpy(), [0.5, 1.0] / high)


def test_actions_of_a_plan_are_taken_until_the_next():
    found = played(planner(CrossEntropy, actions_per_plan=4), 3)
    frames = [each.frame for each in found.decisions]
    assert frames == list(range(0, len(found.history.actions), 4))
    assert all(each.plan.evaluations == 24 * 3 + 1 for each in found.decisions)
    first = found.decisions[0].plan.actions[:4].numpy()
    taken = np.stack(found.history.actions[:4])
    assert np.array_equal(taken, first[: len(taken)])
    facts = found.facts()
    assert facts["rollouts_per_decision"] == 73
    assert facts["steps"] == len(found.history.actions)
    json.dumps(facts, allow_nan=False)


def test_the_simulator_s_futures_are_what_happens():
    """Each candidate, against one uninterrupted episode of the same actions."""
    environment = tiny.Slide()
    past = [np.array([1.0, -0.5], np.float32)] * 3
    actions = 4 * torch.rand(3, 5, 2, generator=torch.Generator().manual_seed(0)) - 2
    history = History(tiny.spec(4), [], past)
    futures = SimulatorFutures(tiny.Slide(), history, actions, 2, None)
    assert futures.length == 3
    found = futures.observe([0, 2]).states["position"].reshape(3, 2, 2)
    assert futures.predicted([0, 2]) is futures.observe([0, 2])  # with cost.read=model, too
    video = futures.video([0, 2])
    for candidate, rows in enumerate(actions.numpy()):
        episode = simulate(environment, tiny.spec(4), np.concatenate([past, rows]), frames=9)
        assert np.array_equal(found[candidate], episode.states["position"][[5, 8]])
        frames = torch.from_numpy(episode.video[[5, 8]]).permute(0, 3, 1, 2) / 255
        torch.testing.assert_close(video[candidate], frames)
    with pytest.raises(RecipeError, match="cost=state"):
        futures.latents([0])


def test_seen_through_the_codec_states_are_those_of_the_reconstruction():
    """Blocks of 4 pixels, which the estimator reads to about as much."""
    from acwm_core.plugins import catalog

    history = History(tiny.spec(4), [], [])
    actions = 4 * torch.rand(3, 4, 2, generator=torch.Generator().manual_seed(0)) - 2
    codec, reader = catalog().create("codec", "blocks"), tiny.SquareEstimator(tiny.Slide.card)
    coded = SimulatorFutures(tiny.Slide(), history, actions, 2, codec, reader)
    true = SimulatorFutures(tiny.Slide(), history, actions, 2, codec)
    read, known = (each.observe([0, 1]).states["position"] for each in (coded, true))
    assert 0 < np.abs(read - known).max() <= 4
    latents = coded.latents([1])
    assert latents.shape == (3, 1, 3, 8, 8)
    torch.testing.assert_close(
        coded.still(np.zeros((32, 32, 3), np.uint8)).mean(), torch.tensor(-1.0)
    )


def test_scripts_and_chance_act_as_they_say():
    solved = played(PolicyController.scripted(solves=True), 0)
    assert solved.success
    with pytest.raises(NoSolutionError, match="'shy' has no scripted solution"):
        played(PolicyController.scripted(solves=True), 0, tiny.SHY)
    policy = played(PolicyController.scripted(solves=False), 0)
    steps = np.stack(policy.history.actions)
    recorded = simulate(tiny.Slide(), tiny.spec(0)).actions
    assert np.array_equal(steps, recorded[: len(steps)])  # the data's own behaviour
    chance = np.stack(played(RandomController(3), 1).history.actions)
    assert np.array_equal(chance[:3], chance[[0, 0, 0]])
    assert not np.array_equal(chance[0], chance[3])
    assert np.array_equal(chance, np.stack(played(RandomController(3), 1).history.actions))


def test_goals_ahead_are_made_by_the_behaviour():
    ahead = TaskVariant(tiny.PLACE, steps=6, max_steps=20)
    stage = tiny.task_environment(ahead)
    stage.reset(options={"spec": tiny.spec(0)})
    goal = stage.goal.state["position"]
    start = stage.environment._position
    step = tiny.Slide().policy(tiny.spec(0).rng("goal:place"))()
    wanted = start
    for _ in range(6):
        wanted = (wanted + step.astype(np.float32)).clip(0, 24)
    assert np.allclose(goal, wanted, atol=1e-4)
    found = play(stage, tiny.spec(0), planner())
    assert found.success
    late = play(
        tiny.task_environment(TaskVariant(tiny.PLACE, steps=None, max_steps=3)),
        tiny.spec(0),
        StillController(),
    )
    assert len(late.history.actions) == 3
