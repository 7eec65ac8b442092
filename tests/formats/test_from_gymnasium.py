"""Rollouts of Gymnasium environments come in as they were played."""

import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError, RecipeError
from acwm_formats.check import check_dataset
from acwm_formats.rollouts import Gymnasium, rollouts
from tests.formats import toy_envs
from tests.formats.conftest import imported

DOT = "tests.formats.toy_envs:Toy/Dot-v0"
COUNTS = (3, 2)


def load(env_id, out, workers=0, shard_episodes=2, **options):
    asked = {name: options.pop(name) for name in ("size", "environment") if name in options}
    recorded = Gymnasium().read(env_id, **{"episodes": COUNTS, "frames": 12} | options)
    return imported(recorded, out, workers, shard_episodes, **asked)


def test_rollouts_can_be_played_again_by_their_actions(tmp_path):
    card = load(DOT, tmp_path / "data").environment
    assert (card.name, card.fps, card.frame_size, card.engine) == ("dot", 20, (40, 40), "Gymnasium")
    assert (card.action.low, card.action.high) == ((-2, -1), (2, 1))
    assert [(field.name, field.shape) for field in card.state] == [("observation", (2,))]
    starts = set()
    env = toy_envs.Dot()
    for split in ("train", "ind_test"):
        for episode in EpisodeDataset(tmp_path / "data", split):
            env.reset()
            env._position = episode.states["observation"][0].copy()
            starts.add(tuple(env._position))
            for t in range(len(episode.video) - 1):
                seen, _, ended, _, _ = env.step(episode.actions[t].astype(np.float64))
                np.testing.assert_allclose(seen, episode.states["observation"][t + 1], atol=1e-5)
                frame = env.render().astype(float)
                wide = np.abs(frame - 50).sum((1, 2)), np.abs(frame - 50).sum((0, 2))
                ours = np.abs(episode.video[t + 1].astype(float) - 50)
                rows = np.corrcoef(wide[0], ours.sum((1, 2)))[0, 1]
                assert rows > 0.99
                assert ended == (t == len(episode.video) - 2 and len(episode.video) < 12) or t == 10
    assert len(starts) == 5
    assert [f for f in check_dataset(tmp_path / "data") if f.problem] == []


def test_a_policy_of_ones_own(tmp_path):
    card = load(DOT, tmp_path / "data", policy="tests.formats.toy_envs:right")
    assert "under the policy tests.formats.toy_envs:right" in card.environment.summary
    actions = EpisodeDataset(tmp_path / "data", "train")[0].actions[:-1]
    assert not actions[:, 0].any()
    assert (actions[:, 1] >= 0.1).all()
    assert len(set(actions[:, 1].tolist())) == len(actions)


def test_discrete_actions_become_one_hot(tmp_path):
    env_id = "tests.formats.toy_envs:Toy/Discrete-v0"
    card = load(env_id, tmp_path / "data").environment
    assert card.action.names == ("action_1", "action_2", "action_3")
    assert (card.action.low, card.action.high) == ((0, 0, 0), (1, 1, 1))
    episode = EpisodeDataset(tmp_path / "data", "train")[0]
    moved = np.diff(episode.states["observation"][:, 0])
    np.testing.assert_allclose(episode.actions[:-1].argmax(1) - 1, moved, atol=1e-9)
    np.testing.assert_array_equal(episode.actions[:-1].sum(1), 1)


def test_a_time_limit_is_the_horizon_and_silence_is_noted(tmp_path):
    card = load("tests.formats.toy_envs:Toy/Quiet-v0", tmp_path / "data", frames=100)
    assert card.environment.horizon == 7
    assert max(EpisodeDataset(tmp_path / "data", "train").lengths) <= 7
    assert card.environment.fps == 10
    assert "has no render_fps" in card.source["notes"][0]


def test_arrays_that_are_used_again_are_copied(tmp_path):
    env_id, policy = "tests.formats.toy_envs:Toy/Reusing-v0", "tests.formats.toy_envs:counting"
    load(env_id, tmp_path / "data", policy=policy, frames=5)
    episode = EpisodeDataset(tmp_path / "data", "train")[0]
    assert episode.video[:, 0, 0, 0].tolist() == [1, 2, 3, 4, 5]
    assert episode.states["observation"][:, 0].tolist() == [1, 2, 3, 4, 5]
    assert episode.actions[:, 0].tolist() == [1, 2, 3, 4, 0]


COUNTING = "tests.formats.toy_envs:Toy/Counting-v0"


def whole_episodes(path):
    """The shape, frames and actions of each episode, in which every frame is of one episode."""
    for split in ("train", "ind_test"):
        for episode in EpisodeDataset(path, split):
            resets, steps, last = episode.video[:, 8, 8].T.tolist()
            taken = episode.actions[:-1].argmax(1).tolist()
            assert len(set(resets)) == 1
            assert steps == list(range(len(episode.video)))
            assert last == [0, *taken]
            assert episode.states["observation"][:, 0].tolist() == steps
            yield len(steps), taken


@pytest.mark.parametrize("mode", ["NextStep", "Disabled", "SameStep"])
def test_a_vector_environment_gives_the_episodes_of_a_single_one(tmp_path, mode):
    load(COUNTING, tmp_path / "single", episodes=(7, 2))
    single = list(whole_episodes(tmp_path / "single"))
    recorded = rollouts(toy_envs.several(mode), "counting", (7, 2))
    card = imported(recorded, tmp_path / "several")
    several = list(whole_episodes(tmp_path / "several"))
    assert len({length for length, _ in single}) > 2
    assert card.environment.fps == 10
    if mode == "SameStep":  # the last frame is never shown
        assert several == [(length - 1, taken[:-1]) for length, taken in single]
        assert "last frame" in card.source["notes"][0]
    else:
        assert several == single


@pytest.mark.parametrize("envs", [{"envs": 4}, {}])
def test_vector_environments_in_workers(tmp_path, envs):
    source = COUNTING if envs else "tests.formats.toy_envs:next_step_in_processes"
    card = load(source, tmp_path / "data", workers=1, episodes=(5, 1), **envs)
    single = rollouts(toy_envs.Counting("rgb_array"), card.environment.name, (5, 1))
    imported(single, tmp_path / "single")
    found = [list(whole_episodes(tmp_path / name)) for name in ("data", "single")]
    assert found[0] == found[1]


def test_a_wrapper_that_a_function_makes(tmp_path):
    load("tests.formats.toy_envs:wrapped", tmp_path / "data")
    assert {length for length, _ in whole_episodes(tmp_path / "data")} == {3, 4}


def test_a_vector_environment_that_takes_one_seed(tmp_path):
    load("tests.formats.toy_envs:Toy/Batch-v0", tmp_path / "data", episodes=(3, 1), envs=2)
    found = list(whole_episodes(tmp_path / "data"))
    assert [length for length, _ in found] == [2, 3, 2, 2]  # the environment i ends after i + 1


def test_our_own_environments_come_in(tmp_path):
    counts = (1, 0)
    card = load("acwm:acwm/push_cube-v0", tmp_path / "data", episodes=counts, frames=3, size=64)
    assert card.environment.frame_size == (64, 64)
    (episode,) = EpisodeDataset(tmp_path / "data", "train")
    assert episode.video.shape == (3, 64, 64, 3)
    assert episode.video.std() > 10


def test_what_cannot_be_imported_is_one_sentence(tmp_path):
    toy = "tests.formats.toy_envs:Toy"
    for env_id, error, problem in (
        ("Nothing-v0", RecipeError, "Gymnasium cannot make 'Nothing-v0'"),
        ("no_such_module:Toy-v0", RecipeError, "No module named 'no_such_module'"),
        (f"{toy}/Endless-v0", DataError, "actions without finite bounds"),
        (f"{toy}/Bits-v0", DataError, "of the kind MultiBinary"),
        (f"{toy}/Blind-v0", DataError, "returns no uint8 frame"),
        (f"{toy}/Broken-v0", DataError, r"cannot be rendered \(OSError: there is no display\)"),
    ):
        with pytest.raises(error, match=problem):
            load(env_id, tmp_path / "data")
    for policy, problem in (
        ("no_such_module:act", "there is no policy 'no_such_module:act'"),
        ("tests.formats.toy_envs:missing", "there is no policy"),
        ("tests.formats.toy_envs:NOTHING", "is not a function"),
    ):
        with pytest.raises(RecipeError, match=problem):
            load(DOT, tmp_path / "data", policy=policy)
    with pytest.raises(
        DataError, match=r"episode 0 of train: the action action_1 is 9 in row 0, .* \[-1, 1\]"
    ):
        load(DOT, tmp_path / "data", policy="tests.formats.toy_envs:too_far")
    for env_id, envs, problem in (
        (DOT, 0, "--envs 0"),
        ("tests.formats.toy_envs:same_step", 2, "--envs is for ids"),
        ("tests.formats.toy_envs:np", None, "cannot make"),
        ("tests.formats.toy_envs:Dot", 2, "--envs is for ids"),
    ):
        with pytest.raises(RecipeError, match=problem):
            load(env_id, tmp_path / "data", envs=envs)
    silent = toy_envs.several("NextStep")
    del silent.metadata["autoreset_mode"]
    with pytest.raises(DataError, match="autoreset_mode"):
        rollouts(silent, "silent", COUNTS)
    with pytest.raises(DataError, match="workers=0"):
        imported(rollouts(toy_envs.several("NextStep"), "counting", COUNTS), tmp_path / "live", 1)
    with pytest.raises(RecipeError, match="no episodes were requested"):
        load(DOT, tmp_path / "data", episodes=(0, 0))
    with pytest.raises(RecipeError, match="give a number such as 100, or 100,10"):
        load(DOT, tmp_path / "data", episodes=(1, 2, 3))
    with pytest.raises(RecipeError, match="--frames 1: give at least 2"):
        load(DOT, tmp_path / "data", frames=1)
    assert "Toy/Dot-v0" in gymnasium.registry


@pytest.mark.ci
def test_policies_and_environments_lie_in_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "my_robot_arm.py").write_text(
        textwrap.dedent(
            """
            import gymnasium
            import numpy as np

            class Arm(gymnasium.Env):
                metadata = {"render_modes": ["rgb_array"], "render_fps": 5}
                action_space = gymnasium.spaces.Box(-1, 1, (1,))
                observation_space = gymnasium.spaces.Box(-9, 9, (1,))
                def __init__(self, render_mode=None):
                    self.render_mode = render_mode
                def reset(self, *, seed=None, options=None):
                    super().reset(seed=seed)
                    return np.zeros(1, np.float32), {}
                def step(self, action):
                    return action, 0.0, False, False, {}
                def render(self):
                    return np.zeros((16, 16, 3), np.uint8)

            def act(observation, rng):
                return np.full(1, 0.5, np.float32)

            gymnasium.register("Arm-v0", "my_robot_arm:Arm")
            """
        )
    )
    command = [Path(sys.executable).parent / "acwm", "data", "import", "gymnasium"]
    options = ["--episodes", "2,2", "--frames", "4", "--policy", "my_robot_arm:act"]
    monkeypatch.chdir(tmp_path)
    subprocess.run(
        [*command, "my_robot_arm:Arm-v0", *options, "--workers", "1", "--out", "out"], check=True
    )
    actions = EpisodeDataset("out", "ind_test")[1].actions
    assert actions[:, 0].tolist() == [0.5, 0.5, 0.5, 0]


def test_frames_that_grow_are_told_with_their_sizes(tmp_path):
    class Growing(toy_envs.Dot):
        def render(self):
            return np.pad(super().render(), ((0, int(self._position[1])), (0, 0), (0, 0)))

    with pytest.raises(DataError, match=r"frames of \d+×44 first and of \d+×44 in frame \d+"):
        imported(rollouts(Growing("rgb_array"), "growing", (2, 1)), tmp_path / "data")


def test_a_rate_below_one_is_kept(tmp_path):
    class Slow(toy_envs.Dot):
        metadata = toy_envs.Dot.metadata | {"render_fps": 0.5}

    card = imported(rollouts(Slow("rgb_array"), "slow", (2, 1), frames=6), tmp_path / "data")
    assert card.environment.fps == 0.5


def test_lengths_are_told_as_a_range(tmp_path):
    data = tmp_path / "data"
    imported(rollouts(toy_envs.Dot("rgb_array"), "dot", (6, 2)), data)
    lengths = [n for split in ("train", "ind_test") for n in EpisodeDataset(data, split).lengths]
    told = CliRunner().invoke(main, ["data", "info", str(data)])
    assert f" {min(lengths)} to {max(lengths)} frames per episode" in told.output
