"""Two commands at once on one folder: the second is told in one sentence, and changes nothing."""

import fcntl
import os
import shutil
import threading
import time
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_core.files import alone, held, made_whole
from acwm_core.plugins import catalog
from acwm_core.training import run_folder
from acwm_planning.resumable import ResumableResults
from tests import tiny
from tests.experiment import parts as experiment
from tests.folders import checksums
from tests.plugins import plugin_of


@pytest.fixture(scope="module", autouse=True)
def parts():
    torch.set_num_threads(1)
    tiny.register()
    # In the same process tests of data may have registered the square before.
    known = "square" in catalog().registry("environment")
    more = {"models": {"waiting": "tests.experiment.parts:WaitingModel"}}
    more |= {} if known else {"environments": {"square": "tests.data.square_world:Square"}}
    if "experiments" not in catalog().plugins:
        catalog().add_plugin(plugin_of(**more), "experiments")


@pytest.fixture(autouse=True)
def hurried(monkeypatch):
    monkeypatch.setattr("acwm_core.files.ENDING_SECONDS", 0.0)


@pytest.fixture(scope="module")
def run(parts, tmp_path_factory):
    return tiny.make_slide_run(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("run/planning/place", ["plan", "run", "place"]),
        ("run/ranking/place", ["rank", "run", "place"]),
        ("run/evaluation", ["evaluate", "run", "evaluation.splits=[train]", "--data", "data"]),
        ("data", ["generate", "slide", "--split", "train", "--episodes", "2", "--out", "data"]),
        ("experiments/widths", ["experiment", "widths.yaml"]),
        (".package.partial", ["new", "metric", "neat", "--out", "package"]),
        (".exported.partial", ["data", "export", "lerobot", "data", "--out", "exported"]),
        (".model.partial", ["ship", "run", "--data", "data", "--out", "model"]),
    ],
)
def test_the_second_is_refused(run, tmp_path, monkeypatch, place, words):
    shutil.copytree(run.parent, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    experiment.write_experiment(tmp_path)
    Path(place).mkdir(parents=True, exist_ok=True)
    (Path(place) / "theirs").write_text("what the first has written\n")
    with held(Path(place)):
        before = checksums(tmp_path)
        refused = CliRunner().invoke(main, words)
        assert checksums(tmp_path) == before
    assert refused.exit_code == 2, refused.output
    said = refused.stderr.splitlines()[-1]  # below the bar of progress
    wanted = place.removeprefix(".").removesuffix(".partial")
    assert said.startswith(f"acwm: another command is writing to {wanted}; wait for it")
    assert "Traceback" not in refused.output


def test_settings_are_those_of_the_command_that_holds_the_results(tmp_path):
    folder = tmp_path / "results"
    folder.mkdir()
    with held(folder), pytest.raises(DataError, match="another command is writing to"):
        ResumableResults(folder, {"weights": "theirs"})
    ResumableResults(folder, {"weights": "ours"})
    with pytest.raises(DataError, match="holds results of another weights"):
        ResumableResults(folder, {"weights": "theirs"})


def test_a_folder_is_made_by_one_at_a_time(tmp_path):
    folder = tmp_path / "made"
    with made_whole(folder) as mine:
        (mine / "file").write_text("mine")
        told = f"another command is writing to {folder};"
        with pytest.raises(DataError, match=told), made_whole(folder):
            pass
    assert [(each.name, each.read_text()) for each in folder.iterdir()] == [("file", "mine")]
    assert [each.name for each in tmp_path.iterdir()] == ["made"]


def test_a_folder_that_another_made_meanwhile_stays(tmp_path):
    folder = tmp_path / "made"

    def overtaken():
        with made_whole(folder) as mine:
            (mine / "file").write_text("mine")
            folder.mkdir()
            (folder / "file").write_text("theirs")

    with pytest.raises(DataError, match=f"another command has created {folder} in the meantime"):
        overtaken()
    assert (folder / "file").read_text() == "theirs"
    assert [each.name for each in tmp_path.iterdir()] == ["made"]


def test_what_a_killed_one_left_is_not_in_a_folder(tmp_path):
    left = tmp_path / ".made.partial"
    (left / "made" / "sub").mkdir(parents=True)
    (left / "made" / "sub" / "file").write_text("of the killed one")
    (left / "made" / "link").symlink_to(tmp_path)
    (left / ".lock").touch()
    with made_whole(tmp_path / "made") as mine:
        (mine / "file").write_text("mine")
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")] == ["made", "made/file"]


def test_two_take_the_same_copy_of_a_trained_model(run, tmp_path, monkeypatch):
    """The second waits for the first, and copies nothing itself."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder, "find_run", lambda name: run)
    run_folder.COPIES.mkdir(parents=True)
    copy, found = run_folder.COPIES / "model", []
    second = threading.Thread(target=lambda: found.append(run_folder.run_to_write("model")))
    with alone(copy):
        second.start()
        with made_whole(copy) as partial:
            shutil.copytree(run, partial, dirs_exist_ok=True)
        monkeypatch.setattr(shutil, "copytree", None)
    second.join()
    assert found == [copy]


def test_a_lock_of_a_lost_node_says_whose_it_is_and_the_way_out(tmp_path):
    """The file system of a cluster may keep a lock whose process has ended on another node."""
    lock = tmp_path / ".lock"
    with lock.open("w") as left:
        left.write("4711\nnode7\n")
        left.flush()
        fcntl.flock(left, fcntl.LOCK_EX)
        os.utime(lock, (time.time() - 3 * 3600,) * 2)
        with pytest.raises(DataError) as refused, held(tmp_path):
            pass
        way_out = f"process 4711 on node7 has held it for 3 h; if that has ended, delete {lock}"
        assert way_out in str(refused.value)
        lock.unlink()
        with (
            held(tmp_path),
            pytest.raises(DataError, match=r"on this machine has held it for \d s\)$"),
            held(tmp_path),
        ):
            pass
