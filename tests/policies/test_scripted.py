"""Scripted policies: what they do to a script, and which are built in."""

import numpy as np
import pytest

from acwm_core.data.simulate import make_environment
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import TaskEnvironment
from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from acwm_planning.policies.scripted import (
    HOLD,
    ScriptedPolicy,
    built_in_policies,
    is_solvable,
    parse_policy,
)
from tests import tiny

STEPS = 12


def stage(seed=0, task=tiny.PLACE):
    made = tiny.task_environment(task)
    made.reset(options={"spec": tiny.spec(seed)})
    return made


def actions(policy, seed=0):
    """Those of an episode in which nothing is moved, so that a script repeats itself."""
    made = stage(seed)
    act = policy.begin(made.environment, made.task, made.goal)
    return np.stack([act() for _ in range(STEPS)])


@pytest.mark.parametrize("solved", [True, False])
def test_at_least_twenty_are_declared_and_no_two_are_alike(solved):
    policies = built_in_policies(solved)
    names = [policy.name for policy in policies]
    assert len({*names}) == len(names) >= 20
    assert [parse_policy(name) for name in names] == policies
    assert solved == any(policy.script == "solution" for policy in policies)
    rows = {np.stack([actions(each, seed) for seed in range(6)]).tobytes() for each in policies}
    assert len(rows) == len(policies)


@pytest.mark.parametrize("skill", [1.0, 0.5, -1.0, 0.0])
def test_a_skill_is_a_share_of_the_script_s_motion(skill):
    whole = actions(ScriptedPolicy("solution"))
    assert np.abs(whole).max() > 0.1
    part = actions(ScriptedPolicy("solution", skill))
    np.testing.assert_allclose(part, skill * whole, atol=1e-6)  # here standing still is 0


def test_noise_is_held_and_a_bias_stays_for_all_episodes():
    noisy = actions(ScriptedPolicy("behaviour", 0.0, noise=0.5))
    assert (noisy[:HOLD] == noisy[0]).all()
    assert (noisy[HOLD] != noisy[0]).all()
    assert 0 < np.abs(noisy).max() <= 0.5 * 2  # half of the way to the bounds
    assert not np.array_equal(noisy, actions(ScriptedPolicy("behaviour", 0.0, noise=0.5), 1))
    assert np.array_equal(noisy, actions(ScriptedPolicy("behaviour", 0.0, noise=0.5)))
    biased = [actions(ScriptedPolicy("behaviour", 0.0, bias=0.25), seed) for seed in (0, 1)]
    assert np.array_equal(*biased)
    assert np.array_equal(np.abs(biased[0]), np.full((STEPS, 2), 0.5))
    assert (np.abs(actions(ScriptedPolicy("solution", bias=9.0))) == 2).all()  # clipped


def test_a_task_may_have_no_solution():
    shy = stage(task=tiny.SHY)
    assert not is_solvable(shy.environment, shy.task, shy.goal)
    with pytest.raises(RecipeError, match="'shy' has no scripted solution"):
        ScriptedPolicy("solution").begin(shy.environment, shy.task, shy.goal)


def test_a_script_that_is_kept_from_its_way_goes_on():
    """One cube's pusher was asked to be where noise kept it from, and the script never answered."""
    pytest.importorskip("mujoco")
    pytest.importorskip("taichi")
    world = make_environment("push_cube", {"size": 16})
    picture = np.zeros((16, 16, 3), np.uint8), np.zeros((16, 16), np.uint8)
    task = catalog().component("environment", "push_cube").load_task("place")
    made = TaskEnvironment(world, task)
    spec = EpisodeSpec("push_cube", "ind_test", 1, options={"size": (16, 16)})
    made.reset(options={"spec": spec})
    world._render = lambda: picture  # rendering takes most of the time
    act = ScriptedPolicy("solution", noise=0.3, bias=0.15).begin(world, task, made.goal)
    actions = []
    for _ in range(task.max_steps):
        actions.append(act())
        made.step(actions[-1])
    assert np.isfinite(actions).all()
    assert np.ptp(actions[-20:], axis=0).max() > 0.1  # it still moves in the end


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("solutoin", "did you mean 'solution'"),
        ("solution,speed=2", "'speed=2' is none of skill=NUMBER"),
        ("solution,skill=1,skill=2", "each once"),
        ("solution,noise=-1", "noise=NUMBER"),
        ("solution,noise=nan", "noise=NUMBER"),
        ("solution,", "'' is none of"),
    ],
)
def test_names_that_are_none(text, message):
    with pytest.raises(RecipeError, match=message):
        parse_policy(text)
