"""`planner.prior`: a planner that starts from what a trained policy would do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.errors import RecipeError
from acwm_core.training.run import load_run
from acwm_planning.controllers import PlanningController
from acwm_planning.costs import StateDistance
from acwm_planning.episode import spec_of_seed, start_of
from acwm_planning.futures import ModelRollouts
from acwm_planning.policies.saved import SavedPolicy
from acwm_planning.sampling import CrossEntropy, RandomShooting
from acwm_planning.simulator import SimulatorRollouts
from tests import tiny
from tests.learning.world import straight


@pytest.fixture(scope="module")
def stage(run, tmp_path_factory):
    bundle, folder = load_run(run), tmp_path_factory.mktemp("prior") / "policy"
    straight(folder)
    reader = tiny.SquareEstimator(bundle.card)
    return ModelRollouts(bundle.world_model, bundle.card, reader), folder


def decided(stage, planner, seed=3):
    rollouts, _ = stage
    env = tiny.task_environment()
    start = start_of(env, spec_of_seed(rollouts.card, seed))
    controller = PlanningController(planner, rollouts, StateDistance())
    controller.begin(env.environment, env.task, start.goal)
    controller.act(start.history)
    return start, controller.decisions[0].plan


def test_the_policy_s_actions_are_the_first_candidate(stage):
    """One other candidate, at random, is worse than the best policy, so its plan is the policy's.

    The model reads whole pixels.
    """
    planner = RandomShooting(candidates=1, horizon=3, prior=str(stage[1]))
    start, plan = decided(stage, planner)
    policy = SavedPolicy.read(stage[1])
    policy.reset(start.goal)
    picture = torch.from_numpy(start.history.frames[-1]).permute(2, 0, 1)[None] / 255
    now = {"position": tiny.corners_of(picture)[0].numpy().astype(float)}
    wanted = policy.predict(now)
    np.testing.assert_allclose(plan.actions[:4].numpy(), np.tile(wanted, (4, 1)), atol=1e-5)
    assert plan.evaluations == 2


def test_a_prior_makes_a_short_search_better(stage):
    few = {"candidates": 4, "elites": 2, "iterations": 1, "horizon": 3}
    gains = []
    for seed in range(4):
        _, plain = decided(stage, CrossEntropy(**few), seed)
        _, led = decided(stage, CrossEntropy(**few, prior=str(stage[1])), seed)
        gains.append(plain.cost - led.cost)
    assert np.mean(gains) > 0


def test_a_policy_of_another_task_or_rate_is_refused(stage, tmp_path):
    rollouts, folder = stage
    whole = SavedPolicy.read(folder)
    SavedPolicy(replace(whole.card, repeat=2), whole._network).save(tmp_path)
    planner = RandomShooting(candidates=1, prior=str(tmp_path))
    with pytest.raises(RecipeError, match="holds an action for 2 frames"):
        PlanningController(planner, rollouts, StateDistance())
    SavedPolicy(replace(whole.card, task="shy"), whole._network).save(tmp_path)
    with pytest.raises(RecipeError, match=r"trained for slide\.shy, not for slide\.place"):
        decided(stage, RandomShooting(candidates=1, prior=str(tmp_path)))


def test_rollouts_of_a_simulator_have_no_place_for_a_policy(stage):
    """Silently without it, the row would be no upper bound of the others."""
    planner = RandomShooting(candidates=1, prior=str(stage[1]))
    with pytest.raises(RecipeError, match=r"planner\.prior"):
        PlanningController(planner, SimulatorRollouts.__new__(SimulatorRollouts), StateDistance())
