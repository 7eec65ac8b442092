"""What every task has in common, by worlds that are fast."""

import re

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.utils.env_checker import check_env

import acwm  # noqa: F401 - registers environments
from acwm_core.checks.task import TaskChecks
from acwm_core.cli.main import main
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.env.task import Goal, Task, TaskEnvironment, observed
from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog, hookimpl
from tests.extras import needs
from tests.tasks.playing import begin, make, solve, spec_of

pytestmark = needs("mujoco", "taichi")


@pytest.fixture(scope="module")
def reacher():
    return make("reacher", "reach")


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_accepts_an_environment_with_a_task(reacher):
    check_env(reacher, skip_render_check=True)


def test_gymnasium_makes_it_with_reward_and_end():
    env = gymnasium.make("acwm/reacher-v0", task="reach", size=64)
    _, info = env.reset(seed=3)
    assert info["distance"] > 0.05
    assert info["success"] is False
    assert isinstance(info["goal"], Goal)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert reward == -info["distance"]
    assert not terminated
    assert not truncated


def test_without_a_task_nothing_changes(reacher):
    usual = simulate(catalog().create("environment", "reacher", size=64), spec_of(reacher))
    frame, _ = begin(reacher)
    np.testing.assert_array_equal(frame, usual.video[0])
    for action, expected in zip(usual.actions[:5], usual.video[1:], strict=False):
        frame, *_ = reacher.step(action)
        np.testing.assert_array_equal(frame, expected)
    bare = gymnasium.make("acwm/reacher-v0", size=64).reset(seed=0)[1]
    assert "distance" not in bare


def test_a_goal_of_the_user_s_is_kept(reacher):
    goal = begin(reacher)[1]["goal"]
    away = goal._replace(state={**goal.state, "fingertip_position": np.array([0.3, -0.4])})
    _, info = reacher.reset(options={"spec": spec_of(reacher), "goal": away})
    assert reacher.goal is info["goal"] is away
    here = info["state"]["fingertip_position"]
    assert info["distance"] == pytest.approx(np.hypot(here[0] - 0.3, here[1] + 0.4))
    _, _, _, _, info = reacher.step(np.zeros(2, np.float32))
    assert reacher.goal is away
    begin(reacher)
    assert np.array_equal(reacher.goal.frame, goal.frame)


def test_a_perturbed_start_is_kept_and_its_goal_is_that_of_the_episode(reacher):
    usual = begin(reacher)[1]
    moved = reacher.reset(options={"spec": spec_of(reacher), "perturbation": 1.0})[1]
    shift = moved["state"]["joint_angle"] - usual["state"]["joint_angle"]
    assert 0 < np.abs(shift).max() < 0.01
    away = moved["goal"].state["goal_position"] - usual["goal"].state["goal_position"]
    assert not away.any()


def test_an_episode_ends_with_success_and_is_cut_off_without(reacher):
    assert solve(reacher)[-1]["success"]
    begin(reacher)
    for step in range(1, reacher.task.max_steps + 1):
        _, _, success, truncated, _ = reacher.step(reacher.environment.still_action())
        assert not success
        assert truncated == (step == reacher.task.max_steps)


def test_distance_is_that_of_whole_clips_too(reacher):
    infos = solve(reacher)
    distances = reacher.task.distance(observed(infos), reacher.goal)
    np.testing.assert_array_equal(distances, [info["distance"] for info in infos])
    success = reacher.task.success(observed(infos), reacher.goal)
    assert success.tolist() == [info["success"] for info in infos]


class Touchy(Task):
    """Counts frames down; the second goal that it draws is not solved at the start."""

    name, summary, unit, tolerance, max_steps = "touchy", "", "", 0.5, 9
    avoid = (("fingertip", "goal"),)

    def __init__(self, goals):
        self.goals = list(goals)

    def sample_goal(self, environment, rng):
        return Goal.now(environment)._replace(state={"tip": np.array(self.goals.pop(0))})

    def distance(self, seen, goal):
        return np.abs(seen.states["fingertip_position"][:, 0] - goal.state["tip"])


def touchy(*goals):
    return TaskEnvironment(catalog().create("environment", "reacher", size=64), Touchy(goals))


@pytest.mark.ci
def test_goals_that_are_reached_at_the_start_are_drawn_again(reacher):
    tip = float(begin(reacher)[1]["state"]["fingertip_position"][0])
    env = touchy(tip, tip + 0.1, tip + 3.0)
    assert begin(env)[1]["distance"] == pytest.approx(3.0)
    with pytest.raises(RecipeError, match=r"is solved at the start of episode \d"):
        begin(touchy(*[tip] * 100))


def test_what_touches_something_that_it_must_avoid_has_failed_for_good(reacher):
    infos = solve(reacher)
    env = touchy(9.0)
    begin(env)
    act = env.environment.reaching(spec_of(env).rng("solution"))
    marker = {env.environment.card.instances.index(name) for name in ("fingertip", "goal")}
    failed = False
    for _ in infos[1:]:
        info = env.step(np.asarray(act(), np.float32))[4]
        failed |= tuple(sorted(marker)) in info["contacts"]
        assert info["failed"] == failed
    assert failed


def test_failure_in_a_frame_spoils_those_that_follow_in_a_clip(reacher):
    class Spoilt(Touchy):
        def failed(self, seen, goal):
            return np.arange(len(seen.masks)) == 1

    seen = observed([begin(reacher)[1]] * 4)
    goal = Goal({"tip": seen.states["fingertip_position"][0, 0]}, seen.masks[0], seen.masks[0])
    assert Spoilt([]).success(seen, goal).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("environment", "task", "message"),
    [
        ("reacher", "reech", "unknown reacher task 'reech'; did you mean 'reach'?"),
        ("cloth_move_8d", "edge", "unknown cloth_move_8d task 'edge'; there is none."),
    ],
)
def test_an_unknown_task_is_one_sentence(environment, task, message):
    with pytest.raises(RecipeError) as caught:
        gymnasium.make(f"acwm/{environment}-v0", task=task)
    assert str(caught.value) == message


def test_tasks_are_listed_without_a_simulator():
    for component in catalog().registry("environment"):
        for name in component.tasks:
            assert component.load_task(name).name == name
            assert f"{component.name}.{name}" in catalog().registry("task")
    listed = CliRunner().invoke(main, ["list", "task"], env={"COLUMNS": "200"}).output
    assert re.search(r"push_cube\.place +acwm_rigid +every cube to its place, within", listed)


def test_a_task_that_cannot_be_imported_is_listed_with_the_reason(fresh_catalog):
    class Plugin:
        @staticmethod
        @hookimpl
        def register_environments(registry):
            registry.add("mine", "a:B", tasks={"lost": "no_such_module:TASK"})

    catalog().add_plugin(Plugin, "mine")
    listed = CliRunner().invoke(main, ["list", "task"], env={"COLUMNS": "200"})
    assert listed.exit_code == 0
    assert re.search(r"mine\.lost +mine +\(.*no_such_module", listed.output)


def test_a_single_task_is_checked_by_its_name(reacher):
    checked = CliRunner().invoke(main, ["check", "reacher.reach"])
    assert checked.exit_code == 0
    assert checked.output.count("  ok ") == 3
    refused = CliRunner().invoke(main, ["check", "reacher.reech"])
    assert refused.exit_code == 2
    assert "unknown component 'reacher.reech'; did you mean 'reacher.reach'?" in refused.stderr


@pytest.mark.parametrize(
    ("flaw", "message"),
    [
        ({"sample_goal": lambda self, env, rng: Goal.now(env)}, "is solved at the start"),
        ({"distance": lambda self, seen, goal: 1 + np.zeros(len(seen.masks))}, "at distance 0"),
        ({"name": "other"}, "the name of task 'flawed' is other, not flawed"),
        ({"solution": lambda self, env, goal, rng: env.still_action}, "leads from"),
    ],
)
def test_acwm_check_finds_flaws(monkeypatch, reacher, flaw, message):
    component = catalog().component("environment", "reacher")
    flawed = type("Flawed", (type(reacher.task),), {"name": "flawed", **flaw})()
    monkeypatch.setattr(type(component), "load_task", lambda self, name: flawed)
    monkeypatch.setitem(component.tasks, "flawed", "here:it")
    monkeypatch.delitem(component.tasks, "reach")
    reasons = [each.reason for each in TaskChecks.check("reacher")]
    assert message in " ".join(reasons)


def test_another_seed_is_another_goal(reacher):
    goals = [
        reacher.reset(options={"spec": EpisodeSpec("reacher", "train", 0, seed)})[1]["goal"]
        for seed in (0, 1)
    ]
    assert not np.array_equal(goals[0].frame, goals[1].frame)
