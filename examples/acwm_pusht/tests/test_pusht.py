import numpy as np
import pytest
import shapely
from acwm_pusht.arena import Arena
from acwm_pusht.pusht import PushT
from acwm_pusht.tasks import POSE, coverage
from gym_pusht.envs import PushTEnv

from acwm_core.checks import check_environment
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal


@pytest.fixture
def pusht():
    env = PushT(size=64)
    env.reset(seed=0)
    return env


def test_it_moves_as_gym_pusht_does(pusht):
    start = [150.0, 150.0, 220.0, 220.0, 0.3]
    other = PushTEnv()
    other.reset(options={"reset_to_state": start})
    pusht.arena.start(np.array(start))
    for pull in np.random.default_rng(0).uniform(0, 40, (20, 2)).astype(np.float32):
        target = np.array(other.agent.position) + pull.astype(float)
        seen, _, _, _, info = other.step(target)
        state = pusht.step(pull)[4]["state"]
        assert [*state["agent"], *state["block"], state["angle"]] == seen.tolist()
    assert np.linalg.norm(seen[2:4] - start[2:4]) > 20
    goal = Arena(30, 0)
    goal.start(np.zeros(5))
    goal.place((256, 256), np.pi / 4)
    wanted = goal.corners()
    assert coverage(state["corners"][None], wanted)[0] == pytest.approx(info["coverage"], abs=1e-6)


def test_masks_show_each_instance_where_it_is(pusht):
    arena = pusht.arena
    arena.start(np.array([60.0, 450.0, 380.0, 120.0, 1.0]))
    _, mask = arena.picture((512, 512))
    bars = shapely.polygons(arena.corners().reshape(2, 4, 2))
    outlined = shapely.buffer(shapely.union_all(bars), 2)
    rows, columns = np.nonzero(mask == 3)
    assert shapely.contains_xy(shapely.buffer(outlined, 2), columns, rows).all()
    assert (mask == 3).sum() == pytest.approx(outlined.area, rel=0.05)
    assert (mask == 4).sum() == pytest.approx(np.pi * 15**2, rel=0.1)
    assert (mask == 2).sum() == pytest.approx(shapely.area(bars).sum(), rel=0.05)


@pytest.mark.parametrize(
    ("moved", "reached"),
    [
        ({"agent": [19, 0]}, True),
        ({"agent": [21, 0]}, False),
        ({"agent": [15, 0], "block": [0, 15]}, False),
        ({"angle": np.radians(341)}, True),
        ({"angle": np.radians(21)}, False),
    ],
)
def test_a_pose_is_reached_as_in_stable_worldmodel(moved, reached):
    state = {"agent": np.full(2, 100.0), "block": np.full(2, 200.0), "angle": np.array(0.0)}
    empty = np.zeros((1, 8, 8), np.uint8)
    seen = {name: (value + moved.get(name, 0))[None] for name, value in state.items()}
    goal = Goal(state, empty[0], np.zeros((8, 8, 3), np.uint8))
    assert POSE.success(Observation(empty, seen), goal).tolist() == [reached]


def test_conforms():
    assert [str(result) for result in check_environment("pusht") if not result.passed] == []
