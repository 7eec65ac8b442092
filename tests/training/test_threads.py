"""Threads of a training on a CPU: the fastest number, kept by the run; who says a number has it."""

import os
from types import SimpleNamespace

import pytest
import torch

from acwm_core.cli import fit as commands
from acwm_core.errors import AcwmError
from acwm_core.recipe import Recipe
from acwm_core.training import threads
from acwm_core.training.launch import fit
from acwm_core.training.run import RunFolder
from acwm_core.training.trainer import L
from tests.training.tiny import Kill, Killed, TinyModel, tiny_recipe, tiny_world_model


@pytest.mark.parametrize(("seconds", "fastest"), [({4: 3, 2: 1, 1: 2}, 2), ({4: 1, 2: 1, 1: 2}, 4)])
def test_the_fastest_number_is_found_and_nothing_changes(monkeypatch, seconds, fastest):
    """By a clock that goes on by what a step is said to take with so many threads."""
    now, world_model = [0.0], tiny_world_model()
    usual = type(world_model).loss

    def loss(self, *given):
        now[0] += seconds[torch.get_num_threads()]
        return usual(self, *given)

    monkeypatch.setattr(type(world_model), "loss", loss)
    monkeypatch.setattr(threads, "time", SimpleNamespace(monotonic=lambda: now[0]))
    before, own = torch.get_rng_state(), torch.get_num_threads()
    weights = {name: value.clone() for name, value in world_model.state_dict().items()}
    try:
        torch.set_num_threads(4)
        plain = L.pytorch.plugins.Precision().forward_context
        assert threads.fastest_threads(world_model, (2, 5), (16, 16), plain) == fastest
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(own)
    assert torch.equal(torch.get_rng_state(), before)
    after = world_model.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in weights.items())
    assert all(parameter.grad is None for parameter in world_model.parameters())


@pytest.fixture
def asked(monkeypatch):
    """How often the number was measured; it is 1."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    calls = []
    monkeypatch.setattr(threads, "fastest_threads", lambda *given: calls.append(given) or 1)
    return calls


def recipe_of(data, **training):
    training = {"cpu_threads": None, **training}
    trainer = {"max_steps": 6, "callbacks": [{"class_path": "tests.training.tiny.Kill"}]}
    return tiny_recipe(data, training=training, trainer=trainer)


def recorded(run):
    return Recipe.from_yaml(RunFolder(run).recipe).training["cpu_threads"]


def test_a_run_keeps_the_number_with_which_it_began(data, tmp_path, monkeypatch, asked):
    monkeypatch.setattr(Kill, "batch", 5)
    with pytest.raises(Killed):
        fit(recipe_of(data), tmp_path / "run")
    assert len(asked) == recorded(tmp_path / "run") == 1
    monkeypatch.setattr(Kill, "batch", None)
    monkeypatch.setattr(threads, "fastest_threads", None)
    fit(recipe_of(data), tmp_path / "run", resume=tmp_path / "run")
    assert recorded(tmp_path / "run") == 1


def test_it_is_tried_with_clips_that_there_are(data, tmp_path, monkeypatch, asked):
    """Episodes of 12 frames hold 6 latent frames of 2, the first of 1."""
    monkeypatch.setattr(Kill, "batch", None)
    recipe = recipe_of(data)
    recipe.data.update(clip_frames=10**9, clip_starts="episode", batch_size=3)
    fit(recipe, tmp_path / "run")
    assert [given[1] for given in asked] == [(3, 11)]


def test_what_the_user_says_wins(data, tmp_path, monkeypatch, asked):
    fit(recipe_of(data, cpu_threads=1), tmp_path / "recipe")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    fit(recipe_of(data), tmp_path / "environment")
    assert asked == []
    assert recorded(tmp_path / "recipe") == 1
    assert recorded(tmp_path / "environment") == torch.get_num_threads()


def test_a_resume_with_other_threads_keeps_the_record(data, tmp_path, monkeypatch, asked):
    monkeypatch.setattr(Kill, "batch", 3)
    with pytest.raises(Killed):
        fit(recipe_of(data), tmp_path / "run")
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(Kill, "batch", 5)
    with pytest.raises(Killed):
        fit(recipe_of(data), tmp_path / "run", resume=tmp_path / "run")
    assert recorded(tmp_path / "run") == len(asked) == 1


@pytest.mark.parametrize(("usual", "counts"), [(8, [8, 4]), (1, [])])
def test_few_numbers_are_tried_with_slow_steps(monkeypatch, usual, counts):
    """A step that scales ideally and takes more than a second is done once per number."""
    now, tried, world_model = [0.0], [], tiny_world_model()
    usually = type(world_model).loss

    def loss(self, *given):
        tried.append(torch.get_num_threads())
        now[0] += 48 / torch.get_num_threads()
        return usually(self, *given)

    monkeypatch.setattr(type(world_model), "loss", loss)
    monkeypatch.setattr(threads, "time", SimpleNamespace(monotonic=lambda: now[0]))
    own = torch.get_num_threads()
    try:
        torch.set_num_threads(usual)
        plain = L.pytorch.plugins.Precision().forward_context
        assert threads.fastest_threads(world_model, (2, 5), (16, 16), plain) == usual
    finally:
        torch.set_num_threads(own)
    assert tried == counts


@pytest.mark.parametrize(
    ("spoiled", "says"),
    [
        (lambda self, *given: torch.zeros(()), "the loss of TinyModel has no gradient"),
        (lambda self, *given: {}["x"], "while numbers of threads were tried"),
    ],
)
def test_a_flawed_model_is_named_by_the_trial(data, tmp_path, monkeypatch, spoiled, says):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(TinyModel, "loss", spoiled)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.raises((AcwmError, KeyError), match=says):
        fit(recipe_of(data), tmp_path / "run")


@pytest.mark.parametrize(
    ("idle", "says", "policy"),
    [(0.9, {}, None), (0.5, {}, "PASSIVE"), (0.5, {"OMP_NUM_THREADS": "2"}, None)],
)
def test_threads_sleep_beside_a_busy_neighbour(monkeypatch, tmp_path, idle, says, policy):
    """Two cores, watched for ten seconds."""
    now, tick = [100.0], os.sysconf("SC_CLK_TCK")
    stat = tmp_path / "stat"

    def spend(seconds):
        now[0] += seconds
        ticks = int(now[0] * idle * tick)
        stat.write_text("".join(f"cpu{c} 9 9 9 {ticks} 0 0 0 0 0 0\n" for c in ("", 0, 1, 2)))

    spend(0)
    monkeypatch.setattr(commands, "LOOK_S", 10)
    monkeypatch.setattr(commands, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=spend))
    monkeypatch.setattr(commands, "Path", lambda name: {"/proc/stat": stat}[name])
    monkeypatch.setattr(commands, "sys", SimpleNamespace(modules={}))
    environment = dict(says)
    system = {"sched_getaffinity": lambda process: {0, 1}, "sysconf": os.sysconf}
    monkeypatch.setattr(commands, "os", SimpleNamespace(environ=environment, **system))
    commands.wait_without_spinning()
    assert environment.get("OMP_WAIT_POLICY") == policy
