"""Training episodes that take the actions of another start."""

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import EPISODES
from square_world import Square

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.generate import generate
from acwm_core.data.simulate import simulate
from acwm_core.errors import DataError, RecipeError


def make(out, exploration, **others):
    """As `square_data` is made, else."""
    return generate(
        "square",
        out,
        episodes=EPISODES,
        exploration=exploration,
        workers=0,
        shard_episodes=4,
        progress=False,
        **others,
    )


def test_exploration_takes_the_actions_of_the_episode_before(square_data, tmp_path):
    """So no shard needs another, and what does not explore is as it was."""
    card = make(tmp_path / "data", exploration=0.6)
    assert "--exploration 0.6" in card.command("data")
    told = CliRunner().invoke(main, ["data", "info", str(tmp_path / "data")]).output
    assert "60% of the training episodes are exploratory" in told
    usual, made = (EpisodeDataset(folder, "train") for folder in (square_data, tmp_path / "data"))
    explored = 0
    for index in range(len(made)):
        before, same = made[max(index - 1, 0)].actions, usual[index]
        if np.array_equal(made[index].actions, same.actions):
            np.testing.assert_array_equal(made[index].video, same.video)
            continue
        explored += 1
        assert index % 4, "the first episode of a shard has none before it"
        np.testing.assert_array_equal(made[index].actions, before)
        np.testing.assert_array_equal(made[index].video[0], same.video[0])
        again = simulate(Square(), made[index].spec, before)
        np.testing.assert_array_equal(made[index].video, again.video)
    assert explored >= 3
    tests = (
        Manifest(folder / "ind_test").checksum() for folder in (square_data, tmp_path / "data")
    )
    assert len({*tests}) == 1


def test_a_shift_moves_one_dimension_of_what_is_reused(square_data, tmp_path):
    """By as much in all frames, unless a bound is in the way; shifts do not add up."""
    card = make(tmp_path / "data", exploration=0.8, shift=0.5)
    assert "--exploration 0.8 --shift 0.5" in card.command("data")
    usual, made = (EpisodeDataset(folder, "train") for folder in (square_data, tmp_path / "data"))
    spec = made.card.environment.action
    low, high = np.array(spec.low), np.array(spec.high)
    chosen, dimensions = None, set()
    for index in range(len(made)):
        actions = made[index].actions[:-1]
        if np.array_equal(made[index].actions, usual[index].actions):
            chosen = actions
            continue
        moved = np.abs(actions - chosen).max(0) > 0
        assert moved.sum() == 1
        (dimension,) = np.flatnonzero(moved)
        offsets = (actions - chosen)[:, dimension]
        offset = offsets[np.abs(offsets).argmax()]
        assert abs(offset) <= 0.5 * (high - low)[dimension] / 2 + 1e-6
        wanted = np.clip(chosen[:, dimension] + offset, low[dimension], high[dimension])
        np.testing.assert_allclose(actions[:, dimension], wanted, atol=1e-6)
        dimensions.add(int(dimension))
    assert len(dimensions) > 1


def test_the_share_is_a_share_and_stays(tmp_path):
    with pytest.raises(RecipeError, match="from 0 to 1"):
        make(tmp_path / "none", exploration=1.5)
    with pytest.raises(RecipeError, match="half an action's range"):
        make(tmp_path / "none", exploration=0.5, shift=-1)
    with pytest.raises(RecipeError, match="set exploration too"):
        make(tmp_path / "none", exploration=0.0, shift=0.5)
    make(tmp_path / "data", exploration=0.6)
    with pytest.raises(DataError, match="exploration"):
        make(tmp_path / "data", exploration=0.1)
    with pytest.raises(DataError, match=r"shift is not set there, 0\.5 now"):
        make(tmp_path / "data", exploration=0.6, shift=0.5)
