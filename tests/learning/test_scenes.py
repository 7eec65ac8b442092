"""Scenes of which only the states are known: those of the model, of the simulator, of the task."""

import numpy as np
import pytest
import torch

from acwm_core.data.simulate import make_environment
from acwm_core.env.task import Goal, TaskEnvironment
from acwm_core.errors import RecipeError
from acwm_core.training.run import load_run
from acwm_dream.starts import DreamStart
from acwm_planning.policies.saved import PolicyInputs
from acwm_policy.episodes import Episodes
from acwm_policy.lesson import begin_episodes, find_task, prepare
from acwm_policy.scenes import DreamScenes, SimulatorScenes
from acwm_scene.node_motion import NodeMotion
from tests import tiny
from tests.scene.dots import world_of
from tests.scene.mechanics import NODES, model_of_arms, model_of_ropes

INPUTS = PolicyInputs({"position": [2]}, {"position": [2]}, [0.0] * 4, [1.0] * 4, [1.0] * 2)


@pytest.fixture(scope="module")
def bundle(run):
    return load_run(run)


@pytest.fixture(scope="module")
def begun(bundle):
    return begin_episodes(bundle.card, 1, tiny.PLACE, 6)


def rows(steps, number, seed=0):
    drawn = np.random.default_rng(seed).uniform(-2, 2, (steps, number, 2))
    return drawn.astype(np.float32)


def arms(stride):
    """A scene whose layers have random weights, as a world model."""
    model = model_of_arms(temporal_stride=stride, latent_channels=192 * stride).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return world_of(model, stride, states=4).eval()


def test_carried_states_are_the_predicted_ones():
    """Of scenes that begin together, and of one that begins when the others are under way."""
    world, random = arms(4), torch.Generator().manual_seed(0)
    frames = torch.rand(3, 3, 32, 32, generator=random)
    actions = torch.rand(3, 17, 2, generator=random) - 0.5
    whole = world.predict_states(frames, actions)["all"]
    stream = world.stream_states(frames)
    begun = stream.picked(torch.tensor([2]))
    first = begun.current["all"]
    passed = [stream.step(actions[:, k : k + 4])["all"] for k in range(0, 16, 4)]
    torch.testing.assert_close(torch.cat(passed, 1), whole, atol=1e-5, rtol=1e-5)
    assert (whole[:, -1] - whole[:, 0]).abs().max() > 0.01
    torch.testing.assert_close(stream.current["all"], passed[-1][:, -1])
    stream.put(torch.tensor([1]), begun)
    torch.testing.assert_close(stream.current["all"][1:2], first)
    later = [stream.step(actions[[0, 2, 1], k : k + 4])["all"] for k in range(0, 16, 4)]
    torch.testing.assert_close(torch.cat(later, 1)[1], whole[2], atol=1e-5, rtol=1e-5)


def test_a_stream_of_some_fields_tells_them():
    world = arms(4)
    stream = world.stream_states(torch.rand(2, 3, 32, 32))
    actions = torch.rand(2, 4, 2) - 0.5
    some = stream.only(["all"]).picked(torch.arange(2))
    torch.testing.assert_close(some.step(actions)["all"], stream.step(actions)["all"])
    with pytest.raises(KeyError, match="velocity"):
        stream.only(["velocity"])


def test_a_model_that_carries_no_states_says_so(tmp_path):
    bundle = load_run(tiny.make_exact_run(tmp_path / "run", states=["position"]))
    with pytest.raises(RecipeError, match="Exact carries no states"):
        bundle.world_model.stream_states(torch.zeros(1, 3, 32, 32))


def test_no_policy_learns_in_a_model_without_states(tmp_path, begun):
    bundle = load_run(tiny.make_exact_run(tmp_path / "run"))
    with pytest.raises(RecipeError, match=r"predicts no states.*\+scene"):
        DreamScenes(bundle.world_model, begun.starts, 1)


def test_dreamt_scenes_are_the_simulated_ones(bundle, begun):
    """The model reads whole pixels and is exact from there on."""
    goals = [start.goal for start in begun.starts]
    dream = DreamScenes(bundle.world_model, begun.starts, 3)
    simulated = SimulatorScenes(bundle.card, begun.specs, goals, dream.repeat, 3)
    for scenes in (dream, simulated):
        scenes.begin([0, 1, 2], [4, 1, 0])
    for step, actions in enumerate(rows(4, 3)):
        if step == 2:
            (one, aims), (other, same) = (each.begin([1], [5]) for each in (dream, simulated))
            assert aims[0] is same[0] is goals[5]
            assert np.abs(one["position"] - other["position"]).max() <= 0.5
        passed = dream.step(actions)["position"]
        assert passed.shape == (3, 4, 2)
        assert np.abs(passed - simulated.step(actions)["position"]).max() <= 0.51


def test_what_draws_starts_says_how_far_it_is(bundle, monkeypatch, capsys):
    """Some goals take seconds to simulate."""
    monkeypatch.setattr("acwm_core.executors.LINE_EVERY_S", 0.0)
    begin_episodes(bundle.card, 1, tiny.PLACE, 3, progress=True)
    assert "starts of slide  3/3 starts" in capsys.readouterr().err


def test_a_dream_moves_no_more_than_is_asked_for(monkeypatch):
    """Such as a gripper without the cloth that it holds; scenes may still begin anew."""
    torch.manual_seed(0)
    model = model_of_ropes(temporal_stride=4, latent_channels=768).eval()
    world = world_of(model, 4, states=2 + 2 * NODES).eval()
    monkeypatch.setattr(world, "state_shapes", {"agent": (2,), "nodes": (2 * NODES,)})
    frames = np.random.default_rng(0).integers(0, 255, (3, 1, 32, 32, 3), np.uint8)
    goal = Goal({}, np.zeros((32, 32), np.uint8), frames[0, 0])
    starts = [DreamStart(each, np.zeros((0, 2), np.float32), goal) for each in frames]
    whole, agents = (DreamScenes(world, starts, 2) for _ in range(2))
    agents.only(["agent"])
    moves = rows(3, 2) / 2

    def passed(scenes):
        scenes.begin([0, 1], [0, 1])
        first = scenes.step(moves[0])
        scenes.begin([1], [2])
        return [first, *map(scenes.step, moves[1:])]

    expected = passed(whole)
    monkeypatch.setattr(NodeMotion, "forward", lambda *_: pytest.fail("nodes are moved"))
    for step, wanted in zip(passed(agents), expected, strict=True):
        np.testing.assert_allclose(step["agent"], wanted["agent"], atol=1e-5)


@pytest.mark.parametrize("task", [tiny.PLACE, tiny.SHY], ids=["place", "shy"])
def test_reward_and_ends_are_those_of_the_task(bundle, begun, task):
    """Against the simulator with its task, action by action, until every scene has ended."""
    goals, number, moves = [start.goal for start in begun.starts], 6, rows(3, 6, seed=1)
    for row, start in enumerate(begun.starts[:3]):  # these go where they are to go
        away = start.goal.state["position"] - world_start(begun.specs[row])
        moves[:, row] = np.clip(away / tiny.STRIDE / np.arange(1, 4)[:, None], -2, 2)
    scenes = SimulatorScenes(bundle.card, begun.specs, goals, tiny.STRIDE, number)
    episodes = Episodes(scenes, task, bundle.card, INPUTS, unit=2.0, bonus=5.0)
    episodes.begin(range(number))
    total, ended = np.zeros(number), {}
    for actions in moves:
        step = episodes.step(torch.from_numpy(actions / 2))
        for row in range(number):
            if row not in ended:
                total[row] += step.rewards[row].item()
                if step.over[row]:
                    ended[row] = {
                        name: value[row].item()
                        for name, value in step._asdict().items()
                        if name in ("solved", "late", "failed", "returns")
                    }
    assert len(ended) == number  # after three steps, the task's twelve actions
    for row in range(number):
        env = TaskEnvironment(make_environment("slide", {"size": (32, 32)}), task)
        _, info = env.reset(options={"spec": begun.specs[row], "goal": goals[row]})
        begin, solved, late = info["distance"], False, False
        for action in np.repeat(moves[:, row], tiny.STRIDE, 0):
            if not (solved or late):
                _, _, solved, late, info = env.step(action)
        assert ended[row]["solved"] == solved
        assert ended[row]["late"] == (late and not solved)
        assert ended[row]["failed"] == info["failed"]
        assert total[row] == pytest.approx((begin - info["distance"]) / 2 + 5 * solved, abs=1e-5)
        assert total[row] == pytest.approx(ended[row]["returns"], abs=1e-5)
    if task is tiny.PLACE:
        assert {info["solved"] for info in ended.values()} == {True, False}
        assert episodes.score(None)["success"] == pytest.approx(
            np.mean([e["solved"] for e in ended.values()])
        )


def world_start(spec):
    env = make_environment("slide", {"size": (32, 32)})
    return env.reset(options={"spec": spec})[1]["state"]["position"]


def test_an_ended_scene_shows_its_last_state_and_begins_anew(bundle, begun):
    lesson = prepare(bundle, tiny.PLACE, begun, "dream", 4)
    assert lesson.measured.inputs.state == lesson.measured.inputs.goal == {"position": [2]}
    scenes = DreamScenes(bundle.world_model, begun.starts, 4)
    episodes = Episodes(scenes, tiny.PLACE, bundle.card, INPUTS, unit=1.0)
    episodes.begin([0, 1, 2, 3])
    for number in range(3):
        step = episodes.step(torch.full((4, 2), -1.0))
        for row in step.over.nonzero()[:, 0]:
            assert step.last[row, :2].abs().max() <= 24 - 8 * (number + 1)  # of 24 pixels, 8 a step
            assert step.vectors[row, 4:].tolist() == [0, 0]  # nothing has moved yet
    assert step.over.any()


def test_a_dream_has_the_gradients_of_its_rewards(bundle, begun):
    """Against small changes of the actions, over two steps, the second from carried states."""

    def rewards(actions):
        scenes = DreamScenes(bundle.world_model, begun.starts, 3)
        options = {"unit": 2.0, "watched": ["position"]}
        episodes = Episodes(scenes, tiny.PLACE, bundle.card, INPUTS, **options)
        episodes.begin([0, 1, 2])
        return torch.stack([episodes.step(row).rewards for row in actions])

    actions = torch.from_numpy(rows(2, 3) / 4)
    leaf = actions.clone().requires_grad_()
    rewards(leaf)[1].sum().backward()
    assert torch.equal(rewards(leaf).detach(), rewards(actions))
    for place in np.ndindex(*actions.shape):
        change = torch.zeros_like(actions)
        change[place] = 0.02
        slope = (rewards(actions + change) - rewards(actions - change))[1].sum() / 0.04
        assert leaf.grad[place] == pytest.approx(slope.item(), abs=0.05)
    assert leaf.grad.abs().max() > 0.5


def test_gradients_end_where_they_are_forgotten(bundle, begun):
    scenes = DreamScenes(bundle.world_model, begun.starts, 2)
    first, second = (torch.full((2, 2), 0.5, requires_grad=True) for _ in range(2))
    scenes.move(first)
    scenes.detach()
    scenes.move(second)["position"].sum().backward()
    assert first.grad is None
    assert second.grad.abs().min() > 0


def test_a_task_that_looks_at_more_is_refused(bundle, begun):
    class Elsewhere(tiny.ToPlace):
        def distance(self, seen, goal):
            return np.asarray(seen.states["velocity"])[:, 0]

    with pytest.raises(RecipeError, match="position are known, and the task 'place' looks at more"):
        prepare(bundle, Elsewhere(), begun, "dream", 2)
    with pytest.raises(RecipeError, match="is a task of reacher, not of slide"):
        find_task("reacher.reach", bundle.card)
    with pytest.raises(RecipeError, match="does not predict it; did you mean 'position'"):
        prepare(bundle, tiny.PLACE, begun, "dream", 2, ["positon"])
