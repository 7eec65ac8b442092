"""Warnings are one line."""

import subprocess
import sys
import warnings

import click
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.errors import AcwmWarning


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
