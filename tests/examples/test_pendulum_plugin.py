"""The example plugin as a user has it: a distribution found by its entry point."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "acwm_pendulum"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder for `PYTHONPATH` with the metadata that pip would write."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    site = tmp_path_factory.mktemp("site")
    info = site / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    info.joinpath("METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = [f"{name} = {target}" for name, target in project["entry-points"]["acwm"].items()]
    info.joinpath("entry_points.txt").write_text("\n".join(["[acwm]", *lines]))
    site.joinpath(project["name"]).symlink_to(EXAMPLE / project["name"])
    return site


def run(installed, *command):
    environment = {**os.environ, "PYTHONPATH": str(installed), "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, *command],
        env=environment,
        cwd=installed,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


ACWM = ("-c", "from acwm_core.cli import main; main()")


def test_its_parts_are_listed(installed):
    listed = run(installed, *ACWM, "list").splitlines()
    assert any("pendulum" in line and "acwm_pendulum" in line for line in listed)
    assert any("angle_error" in line for line in listed)


MAKE = """
import gymnasium
one = gymnasium.make("acwm:acwm/pendulum-v0", size=64)
two = gymnasium.make_vec("acwm/pendulum-v0", 2, vectorization_mode="async", size=64)
print(*(env.reset(seed=0)[0].shape for env in (one, two)))
two.close()
"""


def test_gymnasium_makes_it(installed):
    assert run(installed, "-c", MAKE).strip() == "(64, 64, 3) (2, 64, 64, 3)"


def test_it_stays_short():
    lines = sum(
        len(path.read_text().splitlines())
        for pattern in ("*.py", "*.toml", "*.md")
        for path in EXAMPLE.rglob(pattern)
    )
    assert lines <= 300
