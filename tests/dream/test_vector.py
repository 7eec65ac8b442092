"""Dreams side by side are the same dreams, whoever ends when."""

import gymnasium
import numpy as np
import pytest

import acwm
from acwm_core.errors import AcwmError, ShapeError
from tests import tiny

acwm.register()


def dreams(run, number=3, **settings):
    return gymnasium.make_vec(
        "acwm/dream-v0", num_envs=number, run=run, task="place", device="cpu", **settings
    )


def towards(info, goals):
    """Straight to the goals, as far as a step reaches."""
    away = (goals - info["state"]["position"]) / tiny.STRIDE
    return np.clip(away, -2, 2).astype(np.float32)


def positions(goals):
    return np.stack([goal.state["position"] for goal in goals])


def test_they_are_the_dreams_of_single_environments(run):
    """Two rounds of episodes of which some end early, against one after the other alone."""
    many = dreams(run, max_steps=40)
    assert many.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.NEXT_STEP
    frames, info = many.reset(seed=7)
    goals = positions(info["goal"])
    singles = [
        gymnasium.make("acwm/dream-v0", run=run, task="place", device="cpu", max_steps=40)
        for _ in range(3)
    ]
    begun = [env.reset(seed=7 + k) for k, env in enumerate(singles)]
    assert np.array_equal(frames, np.stack([frame for frame, _ in begun]))
    over, ends = np.zeros(3, bool), np.zeros(3, int)
    for step in range(24):
        rows = towards(info, goals)
        rows[0] *= step % 3 == 0  # so that they end at different times
        frames, rewards, solved, late, info = many.step(rows)
        for k, env in enumerate(singles):
            if over[k]:  # Gymnasium's next step is a reset
                frame, told = env.reset()
                reward, done, cut = 0.0, False, False
                goals[k] = told["goal"].state["position"]
                assert info["_goal"][k]
            else:
                frame, reward, done, cut, told = env.step(rows[k])
            assert np.array_equal(frames[k], frame)
            assert rewards[k] == pytest.approx(reward)
            assert (solved[k], late[k]) == (done, cut)
            assert info["distance"][k] == pytest.approx(told["distance"])
            assert np.array_equal(info["state"]["position"][k], told["state"]["position"])
        over = solved | late
        ends += over
    assert (ends >= 2).all()
    assert len({*ends}) > 1
    assert len(many.unwrapped._dreams._groups) <= 3


def test_spaces_and_seeds(run):
    many = dreams(run, 2)
    assert many.observation_space.shape == (2, 32, 32, 3)
    assert many.action_space.shape == (2, 2)
    same, _ = many.reset(seed=[4, 4])
    assert np.array_equal(same[0], same[1])
    other, _ = many.reset(seed=[4, 5])
    assert np.array_equal(other[0], same[0])
    assert not np.array_equal(other[1], same[1])
    for seed in (0, 3):
        number, _ = many.reset(seed=seed)
        assert np.array_equal(many.reset(seed=np.int64(seed))[0], number)
    one = gymnasium.make("acwm/dream-v0", run=run, device="cpu")
    assert many.unwrapped.metadata["render_fps"] == one.metadata["render_fps"]
    spec, _ = many.reset(options={"spec": tiny.spec(0)})
    assert np.array_equal(spec[0], spec[1])
    kept = spec.copy()
    many.step(np.ones((2, 2), np.float32))
    assert np.array_equal(spec, kept)  # what was returned is the caller's


def test_what_cannot_be(run):
    many = dreams(run, 2)
    with pytest.raises(AcwmError, match="call reset"):
        many.step(np.zeros((2, 2), np.float32))
    with pytest.raises(AcwmError, match="3 seeds for 2"):
        many.reset(seed=[1, 2, 3])
    many.reset(seed=0)
    with pytest.raises(ShapeError, match=r"\(2, 2\), not \(3, 2\)"):
        many.step(np.zeros((3, 2), np.float32))
    with pytest.raises(AcwmError, match="num_envs=0"):
        dreams(run, 0)


def test_seeds_may_be_an_array(run):
    many, same = dreams(run), dreams(run)
    frames, _ = many.reset(seed=np.array([5, 6, 7]))
    assert np.array_equal(frames, same.reset(seed=[5, 6, 7])[0])
    assert np.array_equal(frames, same.reset(seed=np.int64(5))[0])
    for wrong in (np.array([5.0, 6.0, 7.0]), [5, -1, 7], "5", 1.5):
        with pytest.raises(ShapeError, match="a seed is a whole number of 0 or more, not"):
            many.reset(seed=wrong)
    alone = gymnasium.make("acwm/dream-v0", run=run, task="place", device="cpu")
    with pytest.raises(ShapeError, match="a seed is a whole number"):
        alone.reset(seed=np.array([5, 6, 7]))
