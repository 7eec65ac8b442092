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


def make(out, exploration):
    """As `square_data` is made, else."""
    return generate(
        "square",
        out,
        episodes=EPISODES,
        exploration=exploration,
        workers=0,
        shard_episodes=4,
        progress=False,
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


def test_the_share_is_a_share_and_stays(tmp_path):
    with pytest.raises(RecipeError, match="from 0 to 1"):
        make(tmp_path / "none", exploration=1.5)
    make(tmp_path / "data", exploration=0.6)
    with pytest.raises(DataError, match="exploration"):
        make(tmp_path / "data", exploration=0.1)
