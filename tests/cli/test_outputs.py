"""Where a command is told to write: refused in one sentence, before it works, if it cannot."""

import errno
import os
from pathlib import Path

import click
import numpy as np
import pytest

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_core.files import writable
from acwm_core.plugins import catalog
from tests.plugins import plugin_of
from tests.report import synthetic

WORKING = {
    "report": "acwm_report.page.write_report",
    "compare": "acwm_report.comparison.compare_runs",
    "leaderboard": "acwm_report.leaderboard.write_leaderboard",
    "rollout": "acwm_dream.rollout.rollout_run",
    "fit": "acwm_core.training.fit.fit",
    "generate": "acwm_core.data.generate.generate",
    "experiment": "acwm_experiment.runner.run_experiment",
    "jobs of an experiment": "acwm_experiment.runner.submit_experiment",
}
"""What would take long."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name in ("one", "two"):
        synthetic.run(folder / name, synthetic.clips(np.linspace(20, 26, 5)))
    return folder


def said_by(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("acwm: ")
    assert "\n" not in said
    return said


def test_a_bad_place_is_refused_before_the_work(runs, tmp_path, capsys, monkeypatch):
    (tmp_path / "file").touch()
    for work in WORKING.values():
        monkeypatch.setattr(work, lambda *_, **__: pytest.fail("it went to work"))
    one, two = runs / "one", runs / "two"
    commands = [
        ("report", one, "--out"),
        ("compare", one, two, "--out"),
        ("leaderboard", runs, "--out"),
        ("rollout", one, "--out"),
    ]
    for command in commands:
        assert f"{tmp_path} is a folder: name a file" in said_by((*command, tmp_path), capsys)
    folders = [
        ("report", one, "--export"),
        ("fit", "push_cube_small", "--out"),
        ("generate", "push_cube", "--out"),
        ("experiment", "ablations/conditioning_small", "--out"),
        ("experiment", "ablations/conditioning_small", "--out", tmp_path / "new", "--runs"),
        ("experiment", "ablations/conditioning_small", "--executor", "slurm", "--out"),
    ]
    for command in folders:
        said = said_by((*command, tmp_path / "file"), capsys)
        assert f"{tmp_path}/file is not a folder; choose another place" in said


def test_what_the_system_forbids_is_said(tmp_path, monkeypatch):
    """As a user without rights or a file system that is full would see it."""
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    with pytest.raises(DataError, match=f"{tmp_path}/dangling is not a folder"):
        writable(tmp_path / "dangling" / "out")
    with pytest.raises(DataError, match="File name too long"):
        writable(tmp_path / ("x" * 300) / "out")
    locked = tmp_path / "locked"
    locked.mkdir()
    locked.chmod(0o500)
    if os.geteuid():
        with pytest.raises(DataError, match=r"cannot be written .Permission denied.: choose"):
            writable(locked / "out")

    def full(**_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("acwm_core.files.tempfile.TemporaryFile", full)
    with pytest.raises(DataError, match=r"cannot be written .No space left on device.: choose"):
        writable(locked / "out")


def test_a_good_place_stays_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").write_text("mine")
    for path in (Path("new"), Path("deep/er/new"), tmp_path / "deep/new", Path("there")):
        assert writable(path) == path
    assert writable(Path(), folder=True) == Path()
    assert writable(tmp_path, folder=True) == tmp_path
    assert [each.name for each in tmp_path.iterdir()] == ["there"]
    assert (tmp_path / "there").read_text() == "mine"


def test_a_current_folder_that_was_deleted_is_one_sentence(tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(SystemExit) as ended:
        main(["new", "codec", "mine"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said == "acwm: the current folder was deleted; change to another one\n"


@click.command()
@click.argument("number", type=int)
def refused(number):
    raise OSError(number, os.strerror(number), "mine.txt")


def test_what_the_disk_refuses_a_plugins_command_is_no_fault_of_the_plugin(fresh_catalog, capsys):
    catalog().add_plugin(plugin_of(commands={"refused": f"{__name__}:refused"}), "refused")
    said = said_by(["refused", errno.EACCES], capsys)
    assert said == (
        "acwm: mine.txt: Permission denied; free disk space or fix the permissions, and run the "
        "command again"
    )
    said = said_by(["refused", errno.EEXIST], capsys)
    assert said.startswith("acwm: FileExistsError: [Errno 17] File exists: 'mine.txt', in command")


def test_a_folder_that_a_command_makes_whole_is_asked_for_first(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    said = said_by(["new", "metric", "neat", "--out", "file/neat"], capsys)
    assert said == "acwm: cannot write file/neat: file is not a folder; choose another place"
    monkeypatch.setattr(
        "acwm_core.files.tempfile.TemporaryFile", lambda dir: refused.callback(errno.EROFS)
    )
    said = said_by(["new", "metric", "neat"], capsys)
    assert said.startswith("acwm: acwm_neat cannot be written (Read-only file system): choose")
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
