import numpy as np
import pytest
from acwm_robots.ogbench_cube import OGBenchCube
from acwm_robots.so101 import SO101Cube

from acwm_core.checks import check_environment


@pytest.mark.parametrize("world", [SO101Cube, OGBenchCube])
def test_conforms(world):
    assert [str(result) for result in check_environment(world) if not result.passed] == []


@pytest.mark.parametrize("world", [SO101Cube, OGBenchCube])
def test_it_moves_as_the_environment_itself_does(world):
    env, other = world(size=16), world.make()
    rng = np.random.default_rng(0)
    for gym in (env.gym, other):
        gym.reset(seed=3, options={"task_id": 1})
    steps = 5 if world is SO101Cube else 1
    low, high = np.array(world.card.action.low), np.array(world.card.action.high)
    for action in rng.uniform(low, high, (4, len(low))):
        env._advance(action.astype(np.float32))
        for _ in range(steps):
            other.step(action.astype(other.action_space.dtype))
    own, theirs = (each.unwrapped.data.qpos for each in (env.gym, other))
    np.testing.assert_allclose(own, theirs, atol=1e-9)
