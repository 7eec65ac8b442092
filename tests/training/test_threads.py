"""Threads of a training on a CPU: the idle cores, kept by the run; who says a number has it."""

import os
from types import SimpleNamespace

import pytest
import torch

from acwm_core.recipe import Recipe
from acwm_core.training import threads
from acwm_core.training.fit import fit
from acwm_core.training.run import RunFolder
from tests.tiny import tiny_recipe
from tests.training.callbacks import Kill, Killed


@pytest.fixture
def asked(monkeypatch):
    """How often idle cores were counted; there is one, or none."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    calls = []
    monkeypatch.setattr("acwm_core.training.fit.idle_cores", lambda: calls.append(1) or 0.4)
    return calls


def recipe_of(data, **training):
    training = {"cpu_threads": None, **training}
    trainer = {"max_steps": 6, "callbacks": [{"class_path": "tests.training.callbacks.Kill"}]}
    return tiny_recipe(data, training=training, trainer=trainer)


def recorded(run):
    return Recipe.from_yaml(RunFolder(run).recipe).training["cpu_threads"]


def test_a_run_keeps_the_number_with_which_it_began(data, tmp_path, monkeypatch, asked):
    monkeypatch.setattr(Kill, "batch", 5)
    with pytest.raises(Killed):
        fit(recipe_of(data), tmp_path / "run")
    assert len(asked) == recorded(tmp_path / "run") == torch.get_num_threads() == 1
    monkeypatch.setattr(Kill, "batch", 5)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # it is used, and the record stays
    with pytest.raises(Killed):
        fit(recipe_of(data), tmp_path / "run", resume=tmp_path / "run")
    monkeypatch.setattr(Kill, "batch", None)
    monkeypatch.delenv("OMP_NUM_THREADS")
    torch.set_num_threads(2)
    fit(recipe_of(data), tmp_path / "run", resume=tmp_path / "run")
    assert len(asked) == recorded(tmp_path / "run") == torch.get_num_threads() == 1


def test_threads_that_sleep_are_not_spared(data, tmp_path, monkeypatch, asked):
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    torch.set_num_threads(2)
    fit(recipe_of(data), tmp_path / "run")
    assert asked == []
    assert recorded(tmp_path / "run") == 2


def test_what_the_user_says_wins(data, tmp_path, monkeypatch, asked):
    fit(recipe_of(data, cpu_threads=2), tmp_path / "recipe")
    assert recorded(tmp_path / "recipe") == torch.get_num_threads() == 2
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    fit(recipe_of(data), tmp_path / "environment")
    assert recorded(tmp_path / "environment") == 1
    assert asked == []


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
