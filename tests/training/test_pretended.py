"""Training on an accelerator that does not exist, see `pretended_cases`."""

import subprocess
import sys
from pathlib import Path

import pytest

CASES = Path(__file__).with_name("pretended_cases.py")


@pytest.mark.ci
def test_everything_runs_on_an_accelerator_and_no_step_waits_for_it():
    """In a process of its own: PyTorch counts devices once, when it first computes a gradient."""
    words = ["-q", "-n", "0", "-m", "not slow and not gpu", "-p", "no:cacheprovider", str(CASES)]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *words], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout
    assert " passed" in run.stdout
