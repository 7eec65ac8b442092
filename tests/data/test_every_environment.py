"""Episodes of every installed environment and split, from `acwm generate` to the reader."""

import pytest
from click.testing import CliRunner
from test_simulate import assert_same

from acwm_core.cli import main
from acwm_core.data import simulate
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import SPLITS
from tests.checks.results import installed

FRAMES = {"train": 16, "ind_test": 16, "ood_test": None}
"""Of the episode of each split: one is as long as the environment's are."""


@pytest.fixture
def simulated(monkeypatch):
    """The episodes that are simulated, by split, as they were before they were written."""
    made = {}

    def recorded(environment, spec, actions=None):
        made[spec.split] = original(environment, spec, actions, frames=FRAMES[spec.split])
        return made[spec.split]

    original = simulate.simulate
    monkeypatch.setattr(simulate, "simulate", recorded)
    return made


def generate(name, out, *words):
    command = ["generate", name, "--size", "64", "--episodes", "1,1,1", "--out", str(out), *words]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    return out


@pytest.mark.parametrize("part", installed("environment"), ids=lambda part: part.name)
def test_what_is_read_is_what_was_simulated(part, tmp_path, simulated):
    folder = generate(part.name, tmp_path / "data", "--workers", "0")
    assert set(simulated) == set(SPLITS)
    for split, episode in simulated.items():
        (read,) = EpisodeDataset(folder, split)
        assert_same(read, episode)
        assert read.spec == episode.spec
        frames = FRAMES[split] or part.load().card.horizon
        assert len(read.video) == read.actions.shape[0] == frames
        assert (read.ood_label is not None) == (split == "ood_test")
