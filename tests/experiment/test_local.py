"""Processes of this machine: order, side by side, GPUs in turn, and some that will not stop."""

import math
import os
import signal
import subprocess
import threading
import time
from types import SimpleNamespace

import pytest

from acwm_experiment import local
from acwm_experiment.local import LocalRunner, visible_gpus
from acwm_experiment.logs import StepLogs
from acwm_experiment.steps import ExperimentStep


def step(name, script="", needs=(), kind="train"):
    return ExperimentStep(name, kind, (script,), tuple(needs), title=name)


@pytest.fixture
def runner(tmp_path):
    """Makes a runner of shell scripts, which are done if they leave a file of their name."""

    def make(jobs=1, is_done=lambda step: True):
        said = []
        logs = StepLogs(tmp_path)
        return LocalRunner(("bash", "-c"), logs, jobs, said.append, is_done), logs, said

    return make


def printed(logs, name):
    return logs.log(name).read_text().splitlines()[2:]


def test_steps_come_after_what_they_need(runner, tmp_path):
    made, _, said = runner(jobs=3)
    order = tmp_path / "order"
    steps = [
        step(name, f"echo {name} >> {order}", needs)
        for name, needs in (("a", ()), ("b", ("a",)), ("c", ("b", "a", "done before")))
    ]
    assert made.run(steps) == {}
    assert order.read_text().split() == ["a", "b", "c"]
    assert [line for line in said if line.startswith("[")][-1].startswith("[3/3] c: done after")
    assert not list(tmp_path.glob("*.state"))


def test_what_needs_a_failure_is_left_out_and_others_go_on(runner):
    made, logs, _ = runner(is_done=lambda step: step.name != "hollow")
    steps = [
        step("bad", "echo it began; echo 'acwm: no such thing' >&2; exit 2"),
        step("after", "true", ["bad"]),
        step("later", "true", ["after"]),
        step("killed", "kill -9 $$"),
        step("hollow", "echo nothing to see"),
        step("good", "true"),
        step("report", "true", ["after", "good"], "report"),
    ]
    assert made.run(steps) == {
        "bad": "no such thing",
        "after": "skipped, because it needs bad",
        "later": "skipped, because it needs after",
        "killed": "ended by SIGKILL; the last line of its log: none",
        "hollow": "ended without leaving a result; the last line of its log: nothing to see",
    }
    assert logs.state("bad") == "failed"
    assert made.run([step("bad", "true")]) == {}
    assert logs.state("bad") == ""


def test_side_by_side_each_has_its_share(runner, tmp_path, monkeypatch):
    """Of the cores, and of the GPUs that an nvidia-smi lists."""
    listing = tmp_path / "bin" / "nvidia-smi"
    listing.parent.mkdir()
    listing.write_text("#!/bin/sh\necho 'GPU 0: a'\necho 'GPU 1: b'\n")
    listing.chmod(0o755)
    monkeypatch.setenv("PATH", f"{listing.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(local, "available_cores", lambda: 7)
    assert visible_gpus() == ["0", "1"]
    made, logs, _ = runner(jobs=3)
    here = "echo $CUDA_VISIBLE_DEVICES $OMP_NUM_THREADS"
    all_here = f"until [ $(ls {tmp_path}/begun-* | wc -l) = 3 ]; do sleep 0.02; done"
    scripts = {name: f"{here}; touch {tmp_path}/begun-{name}; {all_here}" for name in "abc"}
    assert made.run([step(name, script) for name, script in scripts.items()]) == {}
    assert [printed(logs, name) for name in "abc"] == [["0 2"], ["1 2"], ["0 2"]]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    assert visible_gpus() == ["3"]


@pytest.mark.parametrize("stubborn", [False, True])
def test_a_signal_stops_the_processes(stubborn, runner, tmp_path, monkeypatch):
    """In order, or by force if they ignore it."""
    if stubborn:
        monkeypatch.setattr(local, "PATIENCE", 0.5)
    made, logs, said = runner(jobs=2)
    action = "" if stubborn else f"echo saved > {tmp_path}/saved; exit 75"
    begun = tmp_path / "begun"
    script = f"trap '{action}' TERM; touch {begun}; while true; do sleep 0.05; done"

    def terminate():
        while not begun.exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=terminate).start()
    with pytest.raises(SystemExit) as ended:
        made.run([step("endless", script)])
    assert ended.value.code == 128 + signal.SIGTERM
    assert said[-1].startswith("stopping 1 processes")
    assert (tmp_path / "saved").exists() != stubborn
    assert logs.state("endless") == ""


@pytest.mark.parametrize(
    ("number", "ends"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)]
)
def test_a_signal_stops_a_process_that_is_just_being_started(number, ends, runner, monkeypatch):
    started = []

    def start(*words, **settings):
        started.append(subprocess.Popen(*words, **settings))
        os.kill(os.getpid(), number)
        return started[0]

    monkeypatch.setattr(local, "subprocess", SimpleNamespace(**vars(subprocess) | {"Popen": start}))
    made, logs, said = runner()
    before = signal.getsignal(number)
    with pytest.raises(ends):
        made.run([step("endless", "sleep 600"), step("never", "true")])
    assert said[-1].startswith("stopping 1 processes")
    assert started[0].poll() == -signal.SIGTERM
    assert len(started) == 1
    assert logs.state("endless") == ""
    assert signal.getsignal(number) == before


def test_a_second_signal_kills_them(runner, tmp_path, monkeypatch):
    monkeypatch.setattr(local, "PATIENCE", math.inf)  # so nothing else ends them
    made, _, said = runner()
    begun = tmp_path / "begun"

    def interrupt():
        for told in (begun.exists, lambda: any("stopping" in line for line in said)):
            while not told():
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        made.run([step("endless", f"trap '' TERM; touch {begun}; while true; do sleep 0.05; done")])
