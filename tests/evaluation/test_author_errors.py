"""What an author's code raises is one sentence: the part, the episode or clip, file and line."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.checks import check_environment
from acwm_core.cli import main
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import notes
from acwm_core.plugins import catalog
from tests import tiny
from tests.evaluation import author

HERE = Path(author.__file__)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def broken(parts):
    if "author" not in catalog().plugins:
        catalog().add_plugin(author.plugin, "author")


def line(name):
    """The author's line that is marked so, as messages show it."""
    lines = HERE.read_text().splitlines()
    return f"tests/evaluation/author.py:{1 + next(n for n, t in enumerate(lines) if name in t)}"


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def refused(*words):
    """The sentence that ends a command, after its progress bar."""
    result = run(*words)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    return result.stderr.strip().splitlines()[-1]


EPISODE = ", in episode 0 of train of "

ENVIRONMENTS = [
    (
        "raising_world",
        f"ZeroDivisionError: no ground{EPISODE}raising_world",
        "line of RaisingWorld",
    ),
    ("half_world", f"ValueError: too many values to unpack (expected 2){EPISODE}half_world", None),
    ("policy_world", f"IndexError: list index out of range{EPISODE}", "line of PolicyWorld"),
    (
        "fixed_size_world",
        "__init__() got an unexpected keyword argument 'size', in environment 'fixed_size_world'",
        None,
    ),
    ("unfinished_world", "Can't instantiate abstract class UnfinishedWorld", None),
    ("scalar_policy_world", "policy_world takes actions of shape (2,), not ()", None),
    ("long_policy_world", "policy_world takes actions of shape (2,), not (3,)", None),
    ("deleted_world", ", in environment 'deleted_world' of plugin 'author'", None),
    ("nameless_world", "tests.evaluation.author has no 'NamelessWorld'", None),
]


@pytest.mark.parametrize(("name", "told", "at"), ENVIRONMENTS)
def test_generate_names_part_episode_and_line(name, told, at, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    words = ["--episodes", "1,1,1", "--workers", "0", "--out", tmp_path / "data"]
    said = refused("generate", name, *words)
    assert told in said
    if at:
        assert f"({line(at)}); --traceback shows all of it" in said


def test_a_worker_names_it_as_well(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    words = ["generate", "raising_world", "--episodes", "1,1,1", "--workers", "1"]
    said = refused(*words, "--out", tmp_path / "data")
    assert re.search(r"ZeroDivisionError: no ground, in episode 0 of \w+ of raising_world", said)
    assert line("line of RaisingWorld") in said
    everything = run(*words, "--out", tmp_path / "data", "--traceback")
    assert everything.exit_code == 2
    assert "self.push(action)" in everything.stderr


def test_metrics_name_the_clip(evaluated, monkeypatch):
    monkeypatch.chdir(ROOT)
    words = ["evaluation.metrics=[psnr,raising]", "evaluation.steps_sweep=[]"]
    said = refused("evaluate", evaluated, *words, "--overwrite")
    assert "'nothing', in metric 'raising' in episode 0 of ind_test, from frame 0" in said
    assert line("line of RaisingMetric") in said
    said = refused("evaluate", evaluated, "evaluation.metrics=[psnr,unfinished]", "--overwrite")
    assert "TypeError: Can't instantiate abstract class UnfinishedMetric" in said
    assert "in metric 'unfinished' of plugin 'author'" in said
    checked = run("check", "raising", "env=drift")
    assert checked.exit_code == 1
    assert line("line of RaisingMetric") in checked.output


def test_models_name_the_clips_and_the_step(data, tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    model = {"model": {"name": "raising_model"}}
    run_folder = tiny.make_run(tmp_path / "run", data, parts=model)
    said = refused("evaluate", run_folder)
    assert ", in episode 0 of ind_test, from frame 0 to episode" in said
    assert line("line of RaisingModel") in said
    said = refused(
        *("fit", run_folder / "recipe.yaml", "trainer.max_steps=1", "data.batch_size=2"),
        *("--out", tmp_path / "again"),
    )
    assert ", in training step 1 (" in said
    assert line("line of RaisingModel") in said


def test_a_metric_is_tried_on_an_environment_that_it_can_be_measured_on():
    result = run("check", "drift_only")
    assert result.exit_code == 0, result.output
    elsewhere = run("check", "drift_only", "env=push_cube")
    assert "it cannot be measured here: it is about drifting squares" in elsewhere.output


def test_classes_are_told_as_registered_names_are():
    reasons = [result.reason for result in check_environment(author.RaisingWorld)]
    assert f"ZeroDivisionError: no ground{EPISODE}raising_world (" in reasons[0]
    assert line("line of RaisingWorld").rpartition("/")[2] in reasons[0]


def test_in_python_the_error_itself_arrives_with_a_note():
    with pytest.raises(ZeroDivisionError) as raised:
        simulate(make_environment("raising_world"), EpisodeSpec("raising_world"))
    assert "in episode 0 of train of raising_world" in notes(raised.value)[0]


def test_an_error_without_a_note_is_a_bug_and_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("acwm_core.plugins.Catalog.registry", lambda *_: 1 / 0)
    result = run("list")
    assert isinstance(result.exception, ZeroDivisionError)
    assert result.exit_code == 1
