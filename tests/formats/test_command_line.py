"""Formats on the command line: import, train, report, export; and formats of a third party."""

import json
import re
import shlex

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import DataError
from acwm_core.evaluation.results import Summary
from acwm_core.recipe import compose
from acwm_formats.videos import Videos
from tests.formats import release

QUICK = (
    "trainer.max_steps=2",
    "trainer.enable_progress_bar=false",
    "training.cpu_threads=1",
    "training.sample_every_n_steps=0",
    "data.batch_size=2",
    "data.clip_frames=9",
    "model.width=32",
)

QUICK_EVALUATION = (
    "evaluation.frames=9",
    "evaluation.steps_sweep=[1, 2]",
    "evaluation.device=cpu",
)


def run(*words):
    """Run a command of acwm, which must succeed; returns what it says."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stranger")
    release.environment(folder / "release/rigid_dynamics/push_block")
    said = run("data", "import", "acwm-phys", folder / "release", "--out", folder, "--workers", 0)
    assert "5 train, 2 ind_test, 2 ood_test episodes of push_cube" in said
    assert "units are lost" in said
    return folder / "push_cube"


def test_one_name_is_not_given_to_several_environments(tmp_path):
    for place in ("push_block", "reacher"):
        release.environment(tmp_path / "release" / place, splits={"ind_test": 1}, length=3)
    words = ["acwm-phys", tmp_path / "release", "--out", tmp_path / "data", "--environment", "mine"]
    result = CliRunner().invoke(main, ["data", "import", *map(str, words)])
    assert result.exit_code == 2
    assert "mine" in result.stderr
    assert not (tmp_path / "data").exists()


def test_info_check_and_preview_know_it(imported, tmp_path):
    said = run("data", "info", imported)
    assert "recorded: push_block (acwm-phys)" in said
    assert "normalised to [-1, 1]" in said
    facts = json.loads(run("data", "info", imported, "--json"))
    assert facts["source"]["kind"] == "acwm-phys"
    assert facts["splits"]["ood_test"]["made"] == 2
    assert "not tried: recorded" in run("data", "check", imported)
    run("data", "preview", imported, "--out", tmp_path)
    assert (tmp_path / "preview.png").stat().st_size > 1000


@pytest.mark.ci
def test_training_evaluating_and_reporting(imported, tmp_path):
    folder = tmp_path / "run"
    run("fit", "small", f"data.path={imported}", "--out", folder, *QUICK, "model.channels=8")
    table = run("evaluate", folder, *QUICK_EVALUATION)
    assert "ind_test" in table
    assert "ood_test" in table
    run("report", folder)
    report = (folder / "report.html").read_text()
    assert "on push_cube" in report
    assert "recorded: push_block (acwm-phys)" in report
    assert f"acwm data import acwm-phys push_block --size 64x64 --out {imported}" in report
    run("rollout", folder, "--out", tmp_path / "video.mp4")
    assert (tmp_path / "video.mp4").stat().st_size > 1000


def test_the_recipe_may_name_the_environment_and_must_not_name_another(imported, tmp_path):
    words = ["fit", "push_cube_small", f"data.path={imported}", "--out", tmp_path / "run", *QUICK]
    run(*words)
    wrong = [str(word) for word in ["fit", "small", "env=reacher", *words[2:]]]
    result = CliRunner().invoke(main, wrong)
    assert result.exit_code == 2
    assert "holds episodes of push_cube" in result.stderr
    assert "env=null" in result.stderr


def test_mistakes_are_one_sentence(imported, tmp_path):
    for words, problem in (
        (["acwm-phys", tmp_path], "not in the published layout"),
        (["acwm-phys", tmp_path / "nowhere"], "not in the published layout"),
        (["lerobot", tmp_path], "is not a LeRobot dataset"),
        (["gymnasium", "Nothing-v0", "--episodes", 3], "Gymnasium cannot make"),
        (["gymnasium", "Nothing-v0", "--episodes", "a"], "give a number such as 100"),
        (["lerobot", tmp_path, "--size", "6a"], "give a side such as 64"),
    ):
        command = ["data", "import", *words, "--out", tmp_path / "out"]
        result = CliRunner().invoke(main, [str(word) for word in command])
        assert result.exit_code == 2, words
        assert result.stderr.startswith("acwm: ")
        assert problem in result.stderr
        assert result.stderr.count("\n") == 1
        assert not (tmp_path / "out").exists()
    command = ["data", "export", "hdf5", str(imported), "--out", str(imported)]
    assert "already exists" in CliRunner().invoke(main, command).stderr


def test_exporting_from_the_command_line(imported, tmp_path):
    for form in ("acwm-phys", "lerobot", "hdf5"):
        said = run("data", "export", form, imported, "--out", tmp_path / form)
        assert f"wrote {tmp_path / form}" in said
    again = tmp_path / "acwm-phys/rigid_dynamics/push_block"
    run("data", "import", "acwm-phys", again, "--out", tmp_path / "again", "--workers", 0)
    run("data", "import", "lerobot", tmp_path / "lerobot", "--out", tmp_path / "l", "--workers", 0)
    facts = [json.loads(run("data", "info", tmp_path / n, "--json")) for n in ("again", "l")]
    assert [fact["splits"]["train"]["frames"] for fact in facts] == [60, 60]


def test_printed_commands_name_folders_as_a_shell_reads_them(tmp_path):
    """Spaces and apostrophes in a path are quoted, in an override as well."""
    source, out = tmp_path / "my takes", tmp_path / "Ann's data"
    source.mkdir()
    Videos.example(source)
    said = run("data", "import", "videos", source, "--out", out, "--workers", 0)
    report, fit = re.findall(r"(?:next|with videos): acwm (.*)", said)
    assert shlex.split(report) == ["data", "report", str(out)]
    command, recipe, *overrides = shlex.split(fit)
    assert (command, compose(recipe, overrides).data["path"]) == ("fit", str(out))
    with pytest.raises(DataError, match="was not evaluated") as refused:
        Summary.read(out)
    (evaluate,) = re.findall("`acwm (.*)`", str(refused.value))
    assert shlex.split(evaluate) == ["evaluate", str(out)]
