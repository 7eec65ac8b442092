"""Executors by name: a foreign one makes the same bytes, and gets its options from the command."""

import subprocess
import sys
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from conftest import EPISODES, checksums

from acwm_core import executors
from acwm_core.cli.main import main
from acwm_core.executors import Executor
from acwm_core.plugins import catalog, hookimpl


class BackwardsExecutor(Executor):
    """Runs the last task first, and leaves a note of what it was told."""

    def __init__(self, folder, workers=None, note: str = "none", rounds: int = 1):
        folder.mkdir(parents=True)
        (folder / note).write_text(f"{workers} {rounds}")

    def run(self, function, tasks, report):
        for task in reversed(tasks):
            yield function(task, report)


class Plugin:
    @staticmethod
    @hookimpl
    def register_executors(registry):
        registry.add("backwards", f"{__name__}:BackwardsExecutor", summary="last things first")


def generate(out, *words):
    episodes = ",".join(map(str, EPISODES.values()))
    command = ["generate", "square", "--out", str(out), "--episodes", episodes, *words]
    return CliRunner().invoke(main, command)


def test_a_foreign_executor_generates(tmp_path, monkeypatch):
    if "backwards" not in catalog().plugins:
        catalog().add_plugin(Plugin, "backwards")
    words = ["--executor", "backwards", "--workers", "3", "executor.note=told", "executor.rounds=2"]
    assert generate(tmp_path / "theirs", *words).exit_code == 0
    assert (tmp_path / "theirs" / ".executor" / "told").read_text() == "3 2"
    assert generate(tmp_path / "ours", "--workers", "0").exit_code == 0
    theirs = checksums(tmp_path / "theirs")
    del theirs[".executor/told"]
    assert theirs == checksums(tmp_path / "ours")
    assert "last things first" in CliRunner().invoke(main, ["list", "executor"]).output
    result = generate(tmp_path / "no", "--executor", "backwards", "executor.rounds=two")
    assert result.exit_code == 2
    assert "executor.rounds=two: expected int" in result.output


def test_without_a_terminal_progress_is_told_in_lines(monkeypatch, capsys):
    """By a clock that goes on by four seconds per episode, in lines every ten, and at the end."""
    now = [0]
    monkeypatch.setattr(executors, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with executors.progress_bar("encoding train", 9, done=1, note=lambda: "loss 2") as report:
        for _ in range(8):
            now[0] += 4
            report(1)
    said = capsys.readouterr().err.splitlines()
    assert [line.split()[2] for line in said] == ["4/9", "7/9", "9/9"]
    assert "  loss 2  " in said[0]
    with executors.progress_bar("hidden", 2, shown=False) as report:
        report(2)
    assert capsys.readouterr().err == ""


UNGUARDED = """
from acwm_core.executors import LocalExecutor


def double(task, report):
    return 2 * task


def work():
    print(sorted(LocalExecutor(2).run(double, [1, 2], print)))


{call}
"""


@pytest.mark.parametrize(
    ("call", "works"),
    [
        ("work()", False),
        ("if len('always'):\n    work()", False),
        ("if __name__ == '__main__':\n    print()\nwork()", False),
        ("if __name__ == '__main__':\n    work()", True),
    ],
)
def test_a_script_that_workers_would_run_again_is_refused(call, works, tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(UNGUARDED.format(call=call))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100)
    if works:
        assert "[2, 4]" in done.stdout, done.stderr
    else:
        last = done.stderr.splitlines()[-1]
        assert 'put what it does below `if __name__ == "__main__":`' in last
        assert "memory" not in done.stderr
