"""Ctrl-C while a command starts: exit code 130 and one line, whatever swallows exceptions."""

import signal
import subprocess
import sys
import textwrap

import pytest


def program(tmp_path, body):
    """A process that Ctrl-C reaches at a known place, after acwm took care of it."""
    script = tmp_path / "program.py"
    start = "from acwm_core.interrupts import handle_interrupts\nhandle_interrupts()\n"
    script.write_text(start + textwrap.dedent(body))
    ended = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, cwd=tmp_path, timeout=600
    )
    return ended.returncode, ended.stderr


KILL = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"


@pytest.mark.parametrize("swallow", ["except BaseException: pass", "finally: pass"])
def test_while_a_module_is_imported(swallow, tmp_path):
    (tmp_path / "slow_module.py").write_text(f"try:\n    {KILL}\n{swallow}\n")
    body = """
        try:
            import slow_module
        except BaseException as error:
            raise ImportError("it cannot be imported") from error
        print("went on")
    """
    assert program(tmp_path, body) == (130, "acwm: stopped\n")


def test_in_a_destructor(tmp_path):
    body = f"""
        class Thing:
            def __del__(self):
                {KILL}

        thing = Thing()
        del thing
        print("went on")
    """
    assert program(tmp_path, body) == (130, "acwm: stopped\n")


def test_where_it_can_be_cleaned_up(tmp_path):
    body = f"""
        import sys
        try:
            {KILL}
        except KeyboardInterrupt:
            sys.stderr.write("cleaned up")
    """
    assert program(tmp_path, body) == (0, "cleaned up")


def test_workers_leave_it_to_the_command(tmp_path):
    """They are interrupted from their first moment on, and the task is done all the same."""
    (tmp_path / "work.py").write_text(f"def work(task, report):\n    {KILL}\n    return task\n")
    body = """
        from acwm_core.executors import LocalExecutor
        from work import work

        if __name__ == "__main__":
            print(sorted(LocalExecutor(2).run(work, [1, 2, 3], lambda units: None)), flush=True)
    """
    assert program(tmp_path, body) == (0, "")


def test_the_program_is_told_first_of_all():
    """Before anything that takes time is imported."""
    told = "import acwm_core.interrupts, sys; print(*{'click', 'numpy', 'email'} & {*sys.modules})"
    ended = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert ended.stdout == "\n"


def test_a_background_job_that_ignores_it_still_does(tmp_path):
    script = "from acwm_core.interrupts import *; import os\nhandle_interrupts()\n"
    script += "os.kill(os.getpid(), signal.SIGINT); print('went on')"
    ended = subprocess.run(
        [sys.executable, "-c", script],
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
        capture_output=True,
        text=True,
    )
    assert ended.stdout == "went on\n", ended.stderr
