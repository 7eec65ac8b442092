"""The notebooks run from their first cell to the last, as plain scripts."""

from pathlib import Path

import pytest

from tests.scripts import run_script

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))


@pytest.mark.ci
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_runs(notebook, tmp_path):
    for simulator in ("mujoco", "pybullet", "taichi", "pygame"):
        pytest.importorskip(simulator)
    run_script(notebook, tmp_path, ACWM_CACHE=str(tmp_path / "cache"), QUICK="1")
    pictures = [*tmp_path.glob("*.png"), *tmp_path.glob("*.mp4")]
    assert all(path.stat().st_size > 1000 for path in pictures)


def test_every_notebook_is_there():
    known = {"demo", "own_environment", "own_model", "own_recordings", "planning"}
    assert {path.stem for path in NOTEBOOKS} >= known


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_can_be_converted(notebook):
    jupytext = pytest.importorskip("jupytext", reason="needs the extra docs")
    cells = jupytext.read(notebook).cells
    assert cells[0].source.startswith("# ")
    assert {cell.cell_type for cell in cells} == {"markdown", "code"}
