"""Folders of strangers: nothing outside is read or written, and others' files are left alone."""

import os
import shutil

import pytest
import yaml
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_core.files import inside, parse_yaml, written_whole
from acwm_core.training.run import load_run
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
    return shutil.copytree("tests/reference/first_release/data", tmp_path / "data")


def one_sentence(*arguments):
    """The sentence with which the command ends."""
    result = CliRunner().invoke(main, [str(each) for each in arguments])
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.parametrize("name", ["../mine.txt", "/etc/passwd", "link", "folder/../../mine.txt"])
def test_names_from_files_stay_in_their_folder(tmp_path, mine, name):
    folder = tmp_path / "folder"
    (folder / "folder").mkdir(parents=True)
    (folder / "link").symlink_to(mine)
    assert inside(folder, "folder/x.txt") == folder / "folder/x.txt"
    with pytest.raises(DataError, match="leads out of"):
        inside(folder, name)


def test_a_planted_link_is_not_written_through(tmp_path, mine, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "host")
    (tmp_path / f".new.txt.host-{os.getpid()}.partial").symlink_to(mine)
    with written_whole(tmp_path / "new.txt") as partial:
        partial.write_text("new")
    assert (tmp_path / "new.txt").read_text() == "new"
    assert mine.read_text() == MINE


@pytest.mark.parametrize("what", ["latents", "ind_test", "README.md"])
def test_datasets_whose_own_links_lead_out_are_refused(data, mine, tmp_path, what):
    outside = tmp_path / "outside"
    shutil.copytree(data / "ind_test", outside)
    place = data / what
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(outside if "." not in what else mine)
    before = sorted(outside.iterdir())
    for command in (("data", "info", data), ("encode", data, "--codec", "identity")):
        assert "leads out of" in one_sentence(*command)
    assert sorted(outside.iterdir()) == before
    assert mine.read_text() == MINE


OUT = ["../../evil", "/tmp/evil", "..", "a/../b", "", "a\\b", "-x/y", ".hidden", "a\nb", "x" * 300]


@pytest.mark.parametrize("name", OUT)
def test_a_name_in_a_card_decides_no_folder(data, tmp_path, name):
    """Neither that of the environment nor that of a factor, which name folders and files."""
    card = data / "card.yaml"
    values = yaml.safe_load(card.read_text())
    for change in (
        {"name": name},
        {"factors": [{**values["environment"]["factors"][0], "name": name}]},
    ):
        card.write_text(yaml.safe_dump(values | {"environment": values["environment"] | change}))
        before = {*tmp_path.rglob("*")}
        commands = (
            ("data", "info", data),
            ("benchmark", "export", "--data", data, "--out", tmp_path / "deep/er/tasks"),
            ("encode", data, "--codec", "identity"),
        )
        for command in commands:
            assert "cannot be the name of" in one_sentence(*command)
        assert {*tmp_path.rglob("*")} == before


DEEP = "\n".join(" " * n + "a:" for n in range(2000))


@pytest.mark.parametrize("text", ["&a [*a]", "[" * 2000, DEEP])
def test_cards_and_recipes_that_never_end_are_refused(data, tmp_path, text):
    (data / "card.yaml").write_text(text)
    assert "is not a dataset card" in one_sentence("data", "info", data)
    recipe = text if text == DEEP else f"model: {text}"
    (tmp_path / "recipe.yaml").write_text(recipe)
    assert "is not valid YAML" in one_sentence("fit", tmp_path / "recipe.yaml")


def test_an_alias_is_counted_as_often_as_it_is_used():
    base = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    lines = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 9)]
    assert parse_yaml(base + "".join(lines[:3]))["a3"][0][0][0][0] == "x"
    with pytest.raises(ValueError, match="aliases stand for more than"):
        parse_yaml(base + "".join(lines))


@pytest.mark.parametrize("what", ["card.yaml", "checkpoints", "evaluation"])
def test_runs_whose_own_links_lead_out_are_refused(tmp_path, mine, what):
    folder = shutil.copytree("tests/reference/first_release/run", tmp_path / "run")
    place, elsewhere = folder / what, tmp_path / "elsewhere"
    if place.exists():
        place.replace(elsewhere)
    else:
        elsewhere.mkdir()
    place.symlink_to(elsewhere)
    with pytest.raises(DataError, match="leads out of"):
        load_run(folder)


@pytest.mark.parametrize(
    "what", ["card.yaml", "ind_test/manifest.jsonl", "ind_test/shard-00000.tar"]
)
def test_pipes_are_not_waited_for(data, tmp_path, what):
    (data / what).unlink()
    os.mkfifo(data / what)
    said = one_sentence("data", "info", data)
    assert "is not a regular file" in said or "has no card.yaml" in said
    folder = run(tmp_path / "run", clips([20.0, 21.0, 22.0]))
    for file in ("episodes.parquet", "summary.json"):
        (folder / "evaluation" / file).unlink()
        os.mkfifo(folder / "evaluation" / file)
        assert "is not a regular file" in one_sentence("report", folder)
    assert "not a regular file" in one_sentence("leaderboard", folder)


def test_links_of_others_are_none_of_acwms_business(tmp_path, data, mine):
    """As Weights & Biases puts into a run, and people into a dataset."""
    folder = run(tmp_path / "run", clips([20.0, 21.0, 22.0]))
    (folder / "wandb").mkdir()
    (folder / "wandb/debug.log").symlink_to(mine)
    (data / "notes.txt").symlink_to(mine)
    for command in (("report", folder, "--out", tmp_path / "report.html"), ("data", "info", data)):
        result = CliRunner().invoke(main, [str(each) for each in command])
        assert result.exit_code == 0, result.output
