"""The environment made of a model: by Gymnasium's rules, and against the world it dreams of."""

import gc
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import acwm
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.task import Goal
from acwm_core.errors import AcwmError, RecipeError, ShapeError
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.objectives.regression import Regression
from acwm_dream.environment import Dream
from tests import tiny

acwm.register()


def dream(run, task="place", **settings):
    return gymnasium.make("acwm/dream-v0", run=run, task=task, device="cpu", **settings)


def actions(number, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (number, 2)).astype(np.float32)


@pytest.mark.parametrize("task", ["place", None])
def test_gymnasium_s_checks_pass(run, task):
    env = dream(run, task)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # what another test left is collected here
        warnings.filterwarnings("ignore", ".*recommend using a symmetric")  # actions have units
        check_env(env.unwrapped)


def test_it_is_the_world_that_it_dreams_of(run):
    """Frame by frame and reward by reward, an action held for a latent frame in both."""
    env, true = dream(run), tiny.task_environment()
    assert env.unwrapped.repeat == tiny.STRIDE
    for seed in range(4):
        spec = tiny.spec(seed)
        frame, info = env.reset(seed=seed, options={"spec": spec})
        shown, known = true.reset(options={"spec": spec})
        assert np.abs(frame.astype(int) - shown).max() <= 1
        assert np.array_equal(info["goal"].state["position"], known["goal"].state["position"])
        for action in actions(3, seed):
            frame, reward, over, late, info = env.step(action)
            wanted = 0.0
            for _ in range(tiny.STRIDE):
                _, part, solved, _, told = true.step(action)
                wanted += part
                if solved:
                    break
            assert reward == pytest.approx(wanted, abs=1.5 * tiny.STRIDE)
            away = np.abs(info["state"]["position"] - told["state"]["position"]).max()
            assert away <= 1.5 or solved
            if over or solved:
                break
        else:
            assert late


def test_success_ends_an_episode_and_time_cuts_it_off(run):
    env = dream(run, max_steps=100)
    _, info = env.reset(options={"spec": tiny.spec(0)})
    goal = info["goal"].state["position"]
    for _ in range(25):
        action = np.clip((goal - info["state"]["position"]) / tiny.STRIDE, -2, 2)
        _, _, over, late, info = env.step(action.astype(np.float32))
        if over:
            break
    assert (over, late, info["success"]) == (True, False, True)
    assert info["distance"] <= tiny.PLACE.tolerance
    env = dream(run, max_steps=9)
    env.reset(seed=1)
    ends = [env.step(np.zeros(2, np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True]  # 9 frames are three steps of four


def test_failures_last_and_are_no_success(run):
    env = dream(run, "shy")  # the left half is forbidden
    left = tiny.squares(torch.tensor([[10.0, 6.0]]))[0].permute(1, 2, 0).mul(255).byte().numpy()
    goal = Goal({"position": np.array([10.0, 14.0])}, left[..., 0], left)
    _, info = env.reset(options={"frame": left, "goal": goal})
    assert (info["failed"], info["distance"]) == (True, 8)
    _, _, over, _, info = env.step(np.array([0.0, 2.0], np.float32))
    assert (over, info["failed"], info["distance"]) == (False, True, 0)


def test_starts_of_a_dataset_need_no_simulator(run, data, monkeypatch):
    from acwm_dream import starts

    def absent(*_):
        raise AssertionError("no simulator is asked")

    monkeypatch.setattr(starts, "make_environment", absent)
    env, episodes = dream(run, start="dataset"), EpisodeDataset(data, "train")
    for number in range(len(episodes)):
        frame, info = env.reset(options={"episode": number})
        assert np.abs(frame.astype(int) - episodes[number].video[0]).max() <= 1
        end = episodes[number].states["position"][-1]
        assert np.array_equal(info["goal"].state["position"], end)
    drawn = {env.reset(seed=seed)[0].tobytes() for seed in range(12)}
    assert 1 < len(drawn) <= len(episodes)
    with pytest.raises(RecipeError, match="episode=9: give 0 to 3"):
        env.reset(options={"episode": 9})
    with pytest.raises(RecipeError, match="unknown option 'spec'"):
        env.reset(options={"spec": tiny.spec(0)})


def test_a_picture_is_a_start_and_another_a_goal(run):
    env = dream(run)
    here, there = (
        tiny.squares(torch.tensor([[row, 8.0]]))[0].permute(1, 2, 0).mul(255).byte().numpy()
        for row in (3.0, 15.0)
    )
    frame, info = env.reset(options={"frame": here, "goal": there})
    assert np.abs(frame.astype(int) - here).max() <= 1
    assert info["state"]["position"].tolist() == [3, 8]
    assert (info["goal"].state["position"].tolist(), info["distance"]) == ([15, 8], 12)
    with pytest.raises(RecipeError, match="the task needs a goal"):
        env.reset(options={"frame": here})
    for wrong in (here[:16], here / 255, "nothing"):
        with pytest.raises(RecipeError, match=r"is uint8 \[32, 32, 3\]"):
            env.reset(options={"frame": wrong, "goal": there})


def test_a_model_that_is_given_more_frames_is_given_them(tmp_path, data):
    run = tiny.make_exact_run(tmp_path / "run", path=str(data), context_frames=5)
    episode = EpisodeDataset(data, "train")[1]
    env = dream(run, start="dataset")
    frame, _ = env.reset(options={"episode": 1})
    assert np.abs(frame.astype(int) - episode.video[4]).max() <= 1
    still = dream(run)
    frame, _ = still.reset(options={"spec": tiny.spec(3)})
    true, _ = tiny.task_environment().reset(options={"spec": tiny.spec(3)})
    assert np.abs(frame.astype(int) - true).max() <= 1


def test_episodes_can_be_dreamt_again(run):
    env = dream(run)
    rows = actions(3, 5)

    def played(seed):
        frames = [env.reset(seed=seed)[0], *(env.step(row)[0] for row in rows)]
        return np.stack(frames)

    first = played(3)
    assert not np.array_equal(first, played(4))
    assert np.array_equal(first, played(np.int64(3)))
    seen = env.step(actions(1, 5)[0])[0]
    env.render()[:] = 0  # what was returned is the caller's
    assert np.array_equal(env.render(), seen)
    assert seen.any()


class Windy(tiny.Exact):
    """Draws a wind of up to two pixels per frame, and stays with it."""

    samples = True

    def stream(self, given, *, context, generators):
        stream = super().stream(given, context=context)
        wind = torch.stack([4 * torch.rand(2, generator=each) - 2 for each in generators])
        advance = stream.advance

        def blown(conditioning):
            stream._corners = stream._corners + wind
            return advance(conditioning)

        stream.advance = blown
        return stream


def test_an_episode_draws_one_future_from_its_seed(run, monkeypatch):
    monkeypatch.setattr("tests.tiny.Exact", Windy)
    monkeypatch.setattr(Regression, "check_model", Objective.check_model)  # as if it taught to draw
    env, options, still = dream(run), {"spec": tiny.spec(3)}, np.zeros(2, np.float32)

    def last(seed):
        env.reset(seed=seed, options=options)
        return [env.step(still)[0] for _ in range(2)]

    one, again, other = last(1), last(1), last(2)
    assert np.array_equal(one, again)
    assert not np.array_equal(one[0], other[0])
    steps = [env.reset(seed=1, options=options)[0], *one]
    places = [np.argwhere(each[..., 0] > 100).mean(0) for each in steps]
    assert places[2] - places[1] == pytest.approx(places[1] - places[0], abs=1)  # the same wind


def held_bytes():
    """Of all tensors and arrays that are alive."""
    gc.collect()
    alive = (each for each in gc.get_objects() if issubclass(type(each), torch.Tensor))
    return sum(each.nelement() * each.element_size() for each in alive)


def test_memory_is_constant(tmp_path, data):
    """With a model that has a state: after 4 steps and after 60."""
    from tests.dream.recurrent import make_run

    env = dream(make_run(tmp_path / "run", data), max_steps=1000)
    env.reset(seed=0)
    sizes = []
    for step in range(60):
        frame, *_ = env.step(actions(1, step)[0])
        if step in (4, 59):
            sizes.append(held_bytes())
    assert sizes[0] == sizes[1] > 0
    assert frame.shape == (32, 32, 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"run": None}, "name the model: run="),
        ({"run": "nowhere"}, "there is no run folder and no trained model nowhere"),
        ({"tsk": "place"}, "has no argument 'tsk'; did you mean 'task'"),
        ({"task": "nothing"}, "unknown slide task 'nothing'"),
        ({"start": "sky"}, "start='sky': give 'simulator' or 'dataset'"),
        ({"max_steps": 0}, "max_steps=0: give 1 or more"),
        ({"start": "dataset", "data": "nowhere"}, "nowhere"),
        ({"render_mode": "human"}, "render_mode='human'"),
    ],
)
def test_what_cannot_be_had_is_told_in_a_sentence(run, settings, message):
    words = {"run": run, "task": "place", **settings}
    words = {name: value for name, value in words.items() if value is not None}
    with pytest.raises(AcwmError, match=message):
        Dream(**words)


def test_actions_are_checked(run):
    env = dream(run).unwrapped
    with pytest.raises(AcwmError, match=r"call reset\(\) before step"):
        env.step(np.zeros(2, np.float32))
    env.reset(seed=0)
    for wrong, message in [([9, 0], "out of its bounds"), ([np.nan, 0], "not finite")]:
        with pytest.raises(ShapeError, match=message):
            env.step(np.array(wrong, np.float32))
    with pytest.raises(ShapeError, match="2 action dimensions"):
        env.step(np.zeros(3, np.float32))


def test_a_world_without_an_estimator_has_no_tasks_in_a_dream(tmp_path):
    run = tiny.make_exact_run(tmp_path / "run", environment="unread")
    with pytest.raises(AcwmError, match="no estimator reads the states of unread"):
        dream(run)
    env = dream(run, None)
    _, info = env.reset(seed=0)
    assert env.step(np.ones(2, np.float32))[1:] == (0.0, False, False, {"state": {}})
    assert info == {"state": {}}


def test_a_model_that_cannot_be_streamed_is_refused(tmp_path):
    run = tiny.make_slide_run(tmp_path)
    with pytest.raises(
        RecipeError, match="cannot be used as an environment: a model trained with FullSequence"
    ):
        dream(run, None)
