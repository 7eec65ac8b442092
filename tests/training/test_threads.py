"""Threads of a training on a CPU: the idle cores, kept by the run; who says a number has it."""

import os
from types import SimpleNamespace

import pytest
import torch

from acwm_core.recipe import Recipe
from acwm_core.training import threads
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe


@pytest.fixture
def asked(monkeypatch):
    """How often idle cores were counted; there is one, or none."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    calls = []
    monkeypatch.setattr(threads, "idle_cores", lambda: calls.append(1) or 0.4)
    return calls


def test_a_run_keeps_the_number_with_which_it_began(data, tmp_path, monkeypatch, asked):
    run = tmp_path / "run"

    def train(steps, resume=None):
        chosen = {"cpu_threads": None, "schedule": "constant"}
        fit(tiny_recipe(data, training=chosen, trainer={"max_steps": steps}), run, resume=resume)
        return Recipe.from_yaml(RunFolder(run).recipe).training["cpu_threads"]

    assert train(2) == torch.get_num_threads() == 1
    torch.set_num_threads(2)
    assert train(3, resume=run) == torch.get_num_threads() == 1
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("variables", "given", "used"),
    [
        ({}, {"choose": True}, (1, 1)),  # of the idle cores
        ({"OMP_WAIT_POLICY": "PASSIVE"}, {"choose": True}, (2, 2)),  # those that sleep
        ({"OMP_NUM_THREADS": "2"}, {"choose": True}, (2, 2)),
        ({"OMP_NUM_THREADS": "2"}, {"asked": 1}, (1, 1)),
        ({"OMP_NUM_THREADS": "2"}, {"before": 1}, (1, 2)),  # it is used, and the record stays
        ({}, {"before": 1}, (1, 1)),
        ({}, {"asked": 1, "before": 2}, (1, 1)),
        ({}, {}, (None, 2)),
    ],
)
def test_the_user_the_run_and_the_idle_cores_say_how_many(
    variables, given, used, asked, monkeypatch
):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    torch.set_num_threads(2)
    given = {"asked": None, "before": None, "choose": False, **given}
    assert (threads.use_threads(**given), torch.get_num_threads()) == used
    assert len(asked) == (given["choose"] and not variables)


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """Two cores of three, watched for ten seconds; returns a function of how idle each is."""
    now, tick, stat = [100.0], os.sysconf("SC_CLK_TCK"), tmp_path / "stat"
    environment = {}

    def idle(share):
        def spend(seconds):
            now[0] += seconds
            ticks = int(now[0] * share * tick)
            stat.write_text("".join(f"cpu{c} 9 9 9 {ticks} 0 0 0 0 0 0\n" for c in ("", 0, 1, 2)))

        spend(0)
        clock = SimpleNamespace(monotonic=lambda: now[0], sleep=spend)
        monkeypatch.setattr(threads, "time", clock)
        return environment

    system = {"sched_getaffinity": lambda process: {0, 1}, "sysconf": os.sysconf}
    monkeypatch.setattr(threads, "LOOK_S", 10)
    monkeypatch.setattr(threads, "STAT", stat)
    monkeypatch.setattr(threads, "sys", SimpleNamespace(modules={}))
    monkeypatch.setattr(threads, "os", SimpleNamespace(environ=environment, **system))
    return idle


@pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
def test_idle_cores_are_those_that_this_process_may_use(machine, share):
    machine(share)
    assert threads.idle_cores() == pytest.approx(2 * share, abs=0.01)


@pytest.mark.parametrize(
    ("share", "says", "policy"),
    [(0.9, {}, None), (0.5, {}, "PASSIVE"), (0.5, {"OMP_NUM_THREADS": "2"}, None)],
)
def test_threads_sleep_beside_a_busy_neighbour(machine, share, says, policy):
    environment = machine(share)
    environment.update(says)
    threads.wait_without_spinning()
    assert environment.get("OMP_WAIT_POLICY") == policy
