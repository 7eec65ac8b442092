"""An episode of every installed environment and split, from `acwm generate` to the reader."""

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data import simulate
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.episode import SPLITS
from tests.checks.results import installed


@pytest.fixture
def simulated(monkeypatch):
    """The episodes that are simulated, by split, as they were before they were written."""
    made = {}

    def recorded(environment, spec):
        made[spec.split] = original(environment, spec)
        return made[spec.split]

    original = simulate.simulate
    monkeypatch.setattr(simulate, "simulate", recorded)
    return made


def generate(name, out, *words):
    command = ["generate", name, "--size", "64", "--episodes", "1,1,1", "--out", str(out), *words]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    return out


def same(first, second):
    for field in ("video", "actions", "masks", "contacts"):
        one, other = getattr(first, field), getattr(second, field)
        assert one.dtype == other.dtype, field
        np.testing.assert_array_equal(one, other, field)
    assert set(first.states) == set(second.states)
    for field, values in first.states.items():
        assert values.dtype == second.states[field].dtype, field
        np.testing.assert_array_equal(values, second.states[field], field)
    assert dict(first.factors) == dict(second.factors)
    assert (first.ood_label, first.spec) == (second.ood_label, second.spec)


@pytest.mark.parametrize("part", installed("environment"), ids=lambda part: part.name)
def test_what_is_read_is_what_was_simulated(part, tmp_path, simulated):
    folder = generate(part.name, tmp_path / "data", "--workers", "0")
    assert set(simulated) == set(SPLITS)
    for split, episode in simulated.items():
        (read,) = EpisodeDataset(folder, split)
        same(read, episode)
        assert len(read.video) == read.actions.shape[0] == part.load().card.horizon
        assert (read.ood_label is not None) == (split == "ood_test")


def test_a_worker_writes_the_same(tmp_path):
    parts = installed("environment")
    if not parts:
        pytest.skip("no simulator is installed")
    for workers in "01":
        generate(parts[0].name, tmp_path / workers, "--workers", workers)
    for split in SPLITS:
        same(*(EpisodeDataset(tmp_path / workers, split)[0] for workers in "01"))
