import numpy as np
import pytest
from acwm_dmc.cartpole import CartPole

from acwm_core.checks import check_environment


def test_it_moves_as_the_suite_does():
    from dm_control import suite

    env, other = CartPole(size=16), suite.load("cartpole", "swingup")
    env.reset(seed=0, options={"factors": {"force": 10.0}})
    other.reset()
    with other.physics.reset_context():
        other.physics.data.qpos[:] = env.physics.data.qpos
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 1)).astype(np.float32):
        state = env.step(action)[4]["state"]
        for _ in range(5):
            seen = other.step(action).observation
    x, cosine, sine = seen["position"]
    assert state["cart"][0] == pytest.approx(x)
    assert [np.cos(state["angle"]), np.sin(state["angle"])] == pytest.approx([cosine, sine])
    assert state["velocity"] == pytest.approx(seen["velocity"])
    assert state["tip"] - state["cart"] == pytest.approx([sine, 0, cosine])


def test_conforms():
    assert [str(result) for result in check_environment(CartPole) if not result.passed] == []
