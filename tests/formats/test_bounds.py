"""Bounds of recorded actions: of what moves, of what does not, and without outliers."""

import csv

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_formats.bounds import action_bounds, outliers
from tests.formats.conftest import episodes_of
from tests.formats.corpus import files
from tests.formats.corpus.cases import Case, three


def test_the_range_and_a_place_for_what_never_moves():
    rows = np.array([[-2, 5], [1, 5], [3, 5]], np.float32)
    low, high = action_bounds(rows, quantile=False)
    assert low.tolist() == [-2, 4]
    assert high.tolist() == [3, 6]


def test_quantiles_leave_out_a_hundredth_at_either_end():
    rows = np.append(np.linspace(-1, 1, 200), 1000).astype(np.float32)[:, None]
    (told,) = outliers(rows, ("push",))
    assert "push" in told
    low, high = action_bounds(rows, quantile=True)
    assert -1 <= low[0] <= -0.97
    assert 0.97 <= high[0] <= 1


@pytest.fixture
def takes(tmp_path):
    """Recordings whose actions are ``clock`` from 0 to 0.9 and ``turn`` from -1 to 1."""
    (tmp_path / "takes").mkdir()
    files.videos(tmp_path / "takes", Case("plain", three()))
    return tmp_path / "takes"


def run(takes, out, *words):
    command = ["data", "import", "videos", str(takes), "--out", str(out), "--workers", "0"]
    return CliRunner().invoke(main, [*command, "--test-episodes", "0", *words])


def bounds(folder):
    action = DatasetCard.read(folder).environment.action
    return action.low, action.high


def test_new_recordings_of_the_same_robot_take_the_bounds_of_earlier_ones(takes, tmp_path):
    assert run(takes, tmp_path / "old").exit_code == 0
    for path in takes.glob("*.csv"):  # another day the robot moves half as far, and once too far
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, ["clock", "turn"])
            writer.writeheader()
            for row in rows:
                writer.writerow({"clock": float(row["clock"]) / 2, "turn": float(row["turn"]) / 2})
    assert run(takes, tmp_path / "new").exit_code == 0
    assert bounds(tmp_path / "new") != bounds(tmp_path / "old")
    done = run(takes, tmp_path / "same", "--bounds", str(tmp_path / "old"))
    assert done.exit_code == 0, done.output
    assert bounds(tmp_path / "same") == bounds(tmp_path / "old")
    source = DatasetCard.read(tmp_path / "same").source
    assert "The bounds of actions are those of --bounds." in source["notes"]
    typed = source["command"].split("--bounds ")[1].split()[0]
    assert run(takes, tmp_path / "typed", f"--bounds={typed}").exit_code == 0
    assert bounds(tmp_path / "typed") == bounds(tmp_path / "old")


def test_bounds_that_are_typed_cut_actions_and_say_so(takes, tmp_path):
    done = run(takes, tmp_path / "data", "--bounds", "-0.5,0.5")
    assert done.exit_code == 0, done.output
    assert bounds(tmp_path / "data") == ((-0.5, -0.5), (0.5, 0.5))
    assert "turn from -1 to 1 was cut to [-0.5, 0.5]" in done.output
    rows = np.concatenate([episode.actions for episode in episodes_of(tmp_path / "data")])
    assert (rows.min(), rows.max()) == (-0.5, 0.5)
    assert run(takes, tmp_path / "two", "--bounds", "0,1,-2,2").exit_code == 0
    assert bounds(tmp_path / "two") == ((0, -2), (1, 2))


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("1,-1", "a lower and a higher number"),
        ("0,nan", "a lower and a higher number"),
        ("0,inf", "a lower and a higher number"),
        ("0,1,2", "LOW,HIGH"),
        ("all", "LOW,HIGH"),
        ("0,1,0,1,0,1", "3 dimensions, and the actions 2: clock, turn"),
    ],
)
def test_bounds_that_cannot_be(takes, tmp_path, words, problem):
    done = run(takes, tmp_path / "data", "--bounds", words)
    assert done.exit_code == 2
    assert problem in done.stderr
