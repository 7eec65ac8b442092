"""`acwm new`: every kind is a package that works as it is, and is the author's own."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_templates.kinds import KINDS

NAMES = {"environment": "open_drawer", "scene": "tidy_shelf", "task": "come_back"}
"""Names of an author's; those of other kinds are made of the kind."""


def name_of(kind):
    return NAMES.get(kind, f"fine_{kind}")


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module", params=[*KINDS])
def made(request, tmp_path_factory):
    """The kind and the folder of a new package, with what `pip install -e` would leave in it."""
    kind, name = request.param, name_of(request.param)
    folder = tmp_path_factory.mktemp(kind) / "mine"
    assert run("new", kind, name, "--out", folder).exit_code == 0
    info = folder / f"acwm_{name}-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: acwm_{name}\nVersion: 0.1\n")
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    points = [f"{name} = {value}" for name, value in project["entry-points"]["acwm"].items()]
    (info / "entry_points.txt").write_text("\n".join(["[acwm]", *points]))
    return kind, folder


def python(folder, *arguments):
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_its_own_tests_and_check_pass(made):
    kind, folder = made
    assert "test_conforms" in "".join(path.read_text() for path in folder.glob("tests/*.py"))
    own = ("-q", "--rootdir", str(folder), "-k", "not conforms", "tests")  # which `check` does
    assert " passed" in python(folder, "-m", "pytest", *own)
    name = f"push_cube.{name_of(kind)}" if kind == "task" else name_of(kind)
    checked = python(folder, "-m", "acwm_core.cli", "check", name)
    assert f"{KINDS[kind].registers} {name}\n  ok " in checked


def test_it_is_clean_short_and_the_authors(made):
    kind, folder = made
    texts = {
        path: path.read_text() for path in folder.rglob("*.*") if path.suffix in (".py", ".md")
    }
    assert sum(len(text.splitlines()) for text in texts.values()) <= 330
    camel = "".join(word.capitalize() for word in name_of(kind).split("_"))
    module = folder / f"acwm_{name_of(kind)}" / f"{name_of(kind)}.py"
    assert f"class {camel}(" in texts[module]
    for path, text in texts.items():
        assert not re.search(r"NAME|{{|template|pendulum", str(path.relative_to(folder)) + text)
    python(folder, "-m", "ruff", "check", ".")
    python(folder, "-m", "ruff", "format", "--check", ".")


@pytest.mark.parametrize("name", ["open-drawer", "OpenDrawer", "class", "3d"])
def test_names_that_cannot_be_are_refused(name, tmp_path):
    refused = run("new", "environment", name, "--out", tmp_path / "x")
    assert refused.exit_code == 2
    assert "use snake_case" in refused.output


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("environment", "push_cube", "environment 'push_cube' is installed already"),
        ("planner", "cem", "planner 'cem' is installed already"),
        ("metric", "planning", "a package acwm_planning is installed already"),
        ("codec", "codec", "is what acwm itself calls a part of a codec"),
        ("planner", "plan", "is what acwm itself calls a part of a planner"),
    ],
)
def test_names_that_are_taken_are_refused(kind, name, message, tmp_path):
    refused = run("new", kind, name, "--out", tmp_path / "x")
    assert refused.exit_code == 2
    assert message in refused.output
    assert not (tmp_path / "x").exists()


def test_folders_and_environments_are_looked_at_first(tmp_path):
    (Path(tmp_path) / "there").mkdir()
    assert "choose another --out" in run("new", "codec", "mine", "--out", tmp_path / "there").output
    refused = run("new", "task", "mine", "--environment", "push_cub", "--out", tmp_path / "x")
    assert "did you mean 'push_cube'?" in refused.output
    assert "'environment', 'scene'" in run("new", "car", "mine").output
