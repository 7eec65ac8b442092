"""Warnings are one line: of old spellings, which work for one more release, and all other."""

import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import AcwmWarning

PLAN = ("experiment", "ablations/conditioning_small", "--plan")


def warning(*words: str) -> str:
    """What a command warns of in one line; its exit code is 0."""
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith("acwm: warning: ")
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr


def test_a_warning_does_not_show_the_code_that_gives_it(monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command()
    def careful() -> None:
        warnings.warn("two runs are left out", AcwmWarning, stacklevel=2)

    monkeypatch.setitem(main.commands, "careful", careful)
    assert warning("careful") == "acwm: warning: two runs are left out\n"


def test_keys_of_recipes_and_experiments(tmp_path: Path) -> None:
    recipe = tmp_path / "old.yaml"
    recipe.write_text("extends: push_cube_small\ninstead:\n  model.name: {dit_s: dit_xs}\n")
    assert "instead is now called replace" in warning("show", str(recipe))
    experiment = tmp_path / "experiment.yaml"
    experiment.write_text("rows: {one: {cell: push_cube_small}}\nwords: [+small]\n")
    said = warning("experiment", str(experiment), "--plan", "--out", str(tmp_path / "out"))
    assert "words is now called overrides" in said


def test_parameters() -> None:
    said = warning("show", "push_cube_small", "evaluation.floor_episodes=2")
    assert "evaluation.floor_episodes is now called evaluation.noise_floor_episodes" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((*PLAN, "--slurm"), "--slurm is now called --executor slurm"),
        (
            (*PLAN, "--executor", "slurm", "--sbatch", "--partition=gpu", "--sbatch", "train=--x"),
            "--sbatch is now called executor.sbatch or executor.steps.KIND",
        ),
        (("generate", "push_cube", "--sbatch", "-p cpu"), "--sbatch is now called executor.sbatch"),
        (
            ("generate", "push_cube", "--ray-address", "auto"),
            "--ray-address is now called executor.address",
        ),
    ],
)
def test_options(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acwm_core.executors.create_executor", lambda *_: None)
    monkeypatch.setattr(
        "acwm_core.data.generate.generate", lambda *_, **__: SimpleNamespace(splits={"train": 1})
    )
    assert said in warning(*words, "--out", str(tmp_path / "out"))


def test_an_old_spelling_is_told_once() -> None:
    old = Path("tests/reference/before_objectives/next_frame/recipe.yaml")
    assert "flow" in warning("show", str(old), "flow.shift=7")


def test_no_warning_of_another_library_ends_a_command() -> None:
    """As with PYTHONWARNINGS=error, which children would inherit."""
    code = """
from acwm_core.interrupts import begin_process
begin_process()
import os, sys, warnings
warnings.warn("old", DeprecationWarning)
warnings.warn("new")
print(sys.warnoptions, os.environ.get("PYTHONWARNINGS"))
"""
    words = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout == "[] None\n"
    assert "UserWarning: new" in done.stderr
    assert "old" not in done.stderr
