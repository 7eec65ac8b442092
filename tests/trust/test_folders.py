"""Folders of strangers: no link leads out, no special file is opened, no lock empties a file."""

import os
import shutil

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_core.files import alone, held, written_whole
from tests.report.synthetic import clips, run

MINE = "what the user wrote\n"


@pytest.fixture
def mine(tmp_path):
    """A file of the user's, outside any dataset."""
    file = tmp_path / "mine.txt"
    file.write_text(MINE)
    return file


@pytest.fixture
def data(tmp_path):
    """A finished dataset, as in a stranger's archive."""
    shutil.copytree("tests/reference/first_release/data", tmp_path / "data")
    return tmp_path / "data"


def one_sentence(*arguments, says=""):
    """The command ends with exit code 2 and one sentence."""
    result = CliRunner().invoke(main, [str(each) for each in arguments])
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("acwm: ")
    assert says in result.stderr
    return result.stderr


@pytest.mark.parametrize("locked", [held, lambda folder: alone(folder / "x.npy")])
@pytest.mark.parametrize("kind", ["out", "inside", "pipe", "folder"])
def test_locks_neither_follow_links_nor_empty_files(tmp_path, mine, locked, kind):
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in (".lock", ".x.npy.lock"):
        if kind == "out":
            (folder / name).symlink_to(mine)
        elif kind == "inside":
            (folder / "card.yaml").write_text(MINE)
            (folder / name).symlink_to("card.yaml")
        elif kind == "pipe":
            os.mkfifo(folder / name)
        else:
            (folder / name).mkdir()
    with pytest.raises(DataError, match="is not a regular file"), locked(folder):
        pass
    assert mine.read_text() == MINE
    if kind == "inside":
        assert (folder / "card.yaml").read_text() == MINE


def test_a_lock_that_is_a_file_keeps_its_bytes(tmp_path):
    (tmp_path / ".lock").write_text(MINE)
    with held(tmp_path):
        pass
    assert (tmp_path / ".lock").read_text() == MINE


def test_a_planted_link_is_not_written_through(tmp_path, mine, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "host")
    (tmp_path / f".new.txt.host-{os.getpid()}.partial").symlink_to(mine)
    with written_whole(tmp_path / "new.txt") as partial:
        partial.write_text("new")
    assert (tmp_path / "new.txt").read_text() == "new"
    assert mine.read_text() == MINE


@pytest.mark.parametrize("what", ["latents", "train", "references", "README.md", ".lock"])
def test_datasets_whose_links_lead_out_are_refused(data, mine, tmp_path, what):
    outside = tmp_path / "outside"
    outside.mkdir()
    place = data / what
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(outside if "." not in what else mine)
    for command in (
        ("data", "info", data),
        ("data", "check", data),
        ("encode", data, "--codec", "identity"),
        ("generate", "push_cube", "--size", "32", "--episodes", "1,1,1", "--out", data),
    ):
        said = one_sentence(*command, says=str(place))
        assert "is a link that leads out of" in said or "is not a regular file" in said
    assert not list(outside.iterdir())
    assert mine.read_text() == MINE


@pytest.mark.parametrize("place", ["README.md", "train.tar", "ind_test/.hidden"])
def test_special_files_are_refused_and_not_waited_for(data, place):
    (data / place).unlink(missing_ok=True)
    os.mkfifo(data / place)
    one_sentence("data", "info", data, says=f"{data / place} is not a regular file: remove it")


@pytest.mark.parametrize("place", ["card.yaml", "recipe.yaml", "evaluation/summary.json"])
def test_runs_with_special_files_or_links_are_refused(tmp_path, mine, place):
    folder = run(tmp_path / "run", clips([20.0, 21.0, 22.0]))
    (folder / place).unlink(missing_ok=True)
    (folder / place).symlink_to(mine)
    if place != "recipe.yaml":
        one_sentence("report", folder, says="is a link that leads out of")
    (folder / place).unlink()
    os.mkfifo(folder / place)
    one_sentence("report", folder)


def test_links_within_a_folder_are_fine(data, tmp_path):
    (data / "copy.yaml").symlink_to("card.yaml")
    (data / "nothing").symlink_to("not-there")
    check_folder(data)
    linked = tmp_path / "linked"
    linked.symlink_to(data)  # the folder itself is the user's to name
    assert CliRunner().invoke(main, ["data", "info", str(linked)]).exit_code == 0


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/stdin", "/proc/self/mem"])
def test_devices_are_not_read(device):
    with pytest.raises((DataError, OSError)):
        read_bytes(os.fspath(device), 2**20)
