"""`acwm new`: every kind is a package that works as it is, and is the author's own."""

import ast
import importlib
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import ShapeError
from acwm_formats.arrays import Recording, write_dataset
from acwm_templates.kinds import KINDS
from acwm_templates.package import package_of

NAMES = {
    **{"environment": "open_drawer", "estimator": "open_drawer"},
    **{"scene": "tidy_shelf", "task": "come_back"},
}
"""Names of an author's; those of other kinds are made of the kind."""


def name_of(kind):
    return NAMES.get(kind, f"fine_{kind}")


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """The folders of new packages by kind, with what `pip install -e` would leave in them."""
    folders = {}
    for kind in KINDS:
        name, folder = name_of(kind), tmp_path_factory.mktemp(kind) / "mine"
        assert run("new", kind, name, "--out", folder).exit_code == 0
        package = package_of(kind, name)
        info = folder / f"{package}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1\n")
        project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        points = [f"{name} = {value}" for name, value in project["entry-points"]["acwm"].items()]
        (info / "entry_points.txt").write_text("\n".join(["[acwm]", *points]))
        folders[kind] = folder
    return folders


TRIED = """
import json, os, pathlib, sys, pytest
from click.testing import CliRunner
from acwm_core.cli import main

tried = {}
for kind, (folder, name) in json.loads(sys.argv[1]).items():
    os.chdir(folder)
    own = ["-q", "-p", "no:cacheprovider", "--rootdir", folder, "--import-mode", "importlib"]
    code = pytest.main([*own, "-k", "not conforms", "tests"])  # which `check` does
    checked = CliRunner().invoke(main, ["check", name])
    tried[kind] = int(code), checked.exit_code, checked.output
pathlib.Path(sys.argv[2]).write_text(json.dumps(tried))
"""


def python(folders, *arguments):
    """What a process says that finds the packages in these folders."""
    paths = os.pathsep.join(map(str, folders))
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def registered(kind):
    return f"push_cube.{name_of(kind)}" if kind == "task" else name_of(kind)


@pytest.fixture(scope="module")
def tried(packages, tmp_path_factory):
    """By kind what its own tests and its check said, all in one process: torch takes seconds."""
    file = tmp_path_factory.mktemp("tried") / "tried.json"
    asked = {kind: (str(folder), registered(kind)) for kind, folder in packages.items()}
    output = python(packages.values(), "-c", TRIED, json.dumps(asked), str(file))
    return {kind: (*said, output) for kind, said in json.loads(file.read_text()).items()}


@pytest.mark.ci
@pytest.mark.parametrize("kind", KINDS)
def test_its_own_tests_and_check_pass(kind, packages, tried):
    texts = [path.read_text() for path in packages[kind].glob("tests/*.py")]
    assert "test_conforms" in "".join(texts)
    code, checked, said, output = tried[kind]
    assert code == 0, output
    assert checked == 0, said
    assert f"{KINDS[kind].registers} {registered(kind)}\n  ok " in said


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_short_and_the_authors(kind, packages):
    folder = packages[kind]
    texts = {
        path: path.read_text() for path in folder.rglob("*.*") if path.suffix in (".py", ".md")
    }
    assert sum(len(text.splitlines()) for text in texts.values()) <= 330
    camel = "".join(word.capitalize() for word in name_of(kind).split("_"))
    module = folder / package_of(kind, name_of(kind)) / f"{name_of(kind)}.py"
    assert f"class {camel}(" in texts[module]
    for path, text in texts.items():
        assert not re.search(r"NAME|{{|template|pendulum", str(path.relative_to(folder)) + text)


def test_they_are_clean(packages):
    """By the settings of each."""
    python([], "-m", "ruff", "check", *packages.values())
    python([], "-m", "ruff", "format", "--check", *packages.values())


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
        ("codec", "codec", "is the name of a class that acwm itself uses in a codec"),
        ("planner", "plan", "is the name of a class that acwm itself uses in a planner"),
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


class Spots:
    """Recordings without masks: a spot of (40, 110, 200) at positions in metres."""

    def __len__(self):
        return 1

    def __getitem__(self, index):
        frames = np.full((5, 32, 32, 3), 250, np.uint8)
        corners = np.array([[4, 6], [20, 8], [10, 22], [16, 16], [7, 19]])
        for frame, (x, y) in zip(frames, corners, strict=True):
            frame[y : y + 4, x : x + 4] = (40, 110, 200)
        places = (corners + 2 - 16) / 32 * (0.4, -0.4) + (0.1, 0.3)
        return Recording(frames, np.zeros((4, 1)), {"position": places.astype(np.float32)})


def write_spots(out, state):
    action = ActionSpec(("x",), ("m",), (-1,), (1,), "delta")
    kept = {"name": "open_drawer", "action": action, "fps": 5, "state": state, "progress": False}
    return write_dataset(out, {"train": Spots()}, **kept).environment


def test_an_estimator_reads_recordings_without_masks(packages, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(packages["estimator"]))
    mine = importlib.import_module("acwm_open_drawer_estimator.open_drawer")
    card = write_spots(tmp_path / "data", {"position": "m"})
    mine.measure(str(tmp_path / "data"))
    (line,) = capsys.readouterr().out.splitlines()  # no mask shows a colour
    map_to_world = ast.literal_eval(line.removeprefix("TO_WORLD = "))
    np.testing.assert_allclose(map_to_world, [[0.4, 0, 0.1], [0, -0.4, 0.3]], atol=0.01)

    monkeypatch.setattr(mine, "TO_WORLD", map_to_world)
    estimator = mine.OpenDrawer(card)
    video = torch.from_numpy(Spots()[0].video).permute(0, 3, 1, 2) / 255
    seen = estimator.read(video)
    np.testing.assert_allclose(seen.states["position"], Spots()[0].states["position"], atol=2e-3)
    assert not seen.masks.any()
    assert estimator.physics.objects == ()  # masks could not tell whether one is lost

    with pytest.raises(ShapeError, match="its states are none"):
        mine.OpenDrawer(replace(card, state=()))
    monkeypatch.setattr(mine, "COLOUR", (1.0, 0.0, 0.0))
    with pytest.raises(SystemExit, match="COLOUR is seen in 0 of 5 frames"):
        mine.measure(str(tmp_path / "data"))
