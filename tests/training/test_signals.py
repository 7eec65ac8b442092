"""Signals that end a training: it saves, says how to go on, queues a SLURM job, and goes on."""

import os
import signal
import stat

import pytest

from acwm_core.errors import TrainingError
from acwm_core.training.fit import fit
from acwm_core.training.run import read_metadata
from acwm_core.training.run_folder import RunFolder
from acwm_core.training.signals import SIGNALS, StoppedEarly
from tests.tiny import tiny_recipe
from tests.training.runs import assert_same, numbers


def signalled(data, /, *, accumulated=1, max_steps=16, **init_args):
    send = {"class_path": "tests.training.callbacks.Signal", "init_args": init_args}
    flags = {"callbacks": [send], "accumulate_grad_batches": accumulated, "max_steps": max_steps}
    return tiny_recipe(data, trainer=flags)


@pytest.fixture(autouse=True)
def handlers():
    """Those of before are back after every training."""
    before = [signal.getsignal(number) for number in SIGNALS]
    yield
    assert [signal.getsignal(number) for number in SIGNALS] == before


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A SLURM job, with a `scontrol` that writes down what it is told; it fails if asked to."""
    told = tmp_path / "told"
    command = tmp_path / "bin" / "scontrol"
    command.parent.mkdir()
    command.write_text(
        f'#!/bin/sh\n[ -n "$REFUSE" ] && echo "no $2" >&2 && exit 1\necho "$@" >> {told}\n'
    )
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{command.parent}:{os.environ['PATH']}")
    job = {"JOB_ID": "123", "JOB_NAME": "train", "NTASKS": "1", "PROCID": "0", "LOCALID": "0"}
    for name, value in {**job, "NODEID": "0", "NNODES": "1", "NTASKS_PER_NODE": "1"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    return told


@pytest.fixture
def again(monkeypatch):
    """What the queue does: the very same command once more, in a world without signals."""

    def run(recipe, folder, **words):
        monkeypatch.setenv("SPARED", "1")
        return fit(recipe, folder, resume="auto", **words)

    return run


def without_validation(run, step):
    """The logged numbers but those of a validation."""
    return {
        (at, name): value
        for (at, name), value in numbers(run).items()
        if at != str(step) or not name.startswith("val/")
    }


@pytest.mark.parametrize("batch", [7, *(pytest.param(n, marks=pytest.mark.slow) for n in (6, 9))])
def test_a_step_is_finished_saved_and_gone_on_from(batch, whole, data, tmp_path, again):
    """In the step before a validation, between two checkpoints, and right after one."""
    run = RunFolder(tmp_path / "run")
    with pytest.raises(StoppedEarly) as stopped:
        fit(signalled(data, batch=batch), run.path, resume="auto")
    assert str(stopped.value) == (
        f"stopped by SIGTERM, saved step {batch + 1}; "
        f"continue with `acwm fit resume={run.path} --trust-recipe`"
    )
    assert stopped.value.exit_code == 75
    assert read_metadata(run.weights)["step"] == batch + 1
    again(signalled(data, batch=batch), run.path)
    assert numbers(run) == (without_validation(whole, 7) if batch == 7 else numbers(whole))


def test_ctrl_c_saves_the_step_and_its_advice_is_true(whole, data, tmp_path, again, capfd):
    """Before any checkpoint was due, too: then it used to advise what could not be done."""
    run = RunFolder(tmp_path / "run")
    recipe = signalled(data, batch=1, number=signal.SIGINT)
    with pytest.raises(StoppedEarly) as stopped:
        fit(recipe, run.path)
    advice = f"continue with `acwm fit resume={run.path} --trust-recipe`"
    assert str(stopped.value) == f"stopped by Ctrl-C, saved step 2; {advice}"
    assert stopped.value.exit_code == 130
    assert "acwm: saving this step" in capfd.readouterr().err
    assert read_metadata(run.weights)["step"] == 2
    again(recipe, run.path)
    assert_same(whole, run)


@pytest.mark.parametrize("batch", [pytest.param(1, marks=pytest.mark.slow), 7])
def test_a_second_ctrl_c_does_not_wait(batch, whole, data, tmp_path, again):
    init_args = {"batch": batch, "number": int(signal.SIGINT)}
    twice = [{"class_path": "tests.training.callbacks.Signal", "init_args": init_args}] * 2
    recipe, run = tiny_recipe(data, trainer={"callbacks": twice}), RunFolder(tmp_path / "run")
    with pytest.raises(StoppedEarly, match="interrupted; ") as stopped:
        fit(recipe, run.path)
    assert stopped.value.exit_code == 130
    assert f"`acwm fit resume={run.path} " in str(stopped.value)
    again(recipe, run.path)
    assert_same(whole, run)


def test_a_validation_is_cut_short(whole, data, tmp_path, again):
    run = RunFolder(tmp_path / "run")
    with pytest.raises(StoppedEarly, match="saved step 8"):
        fit(signalled(data, batch=7, validation=True), run.path)
    again(signalled(data, batch=7, validation=True), run.path)
    assert numbers(run) == without_validation(whole, 7)


@pytest.fixture(scope="module")
def of_three(data, tmp_path_factory):
    """A run of six steps, each of three batches."""
    recipe = tiny_recipe(data, trainer={"max_steps": 6, "accumulate_grad_batches": 3})
    return RunFolder(fit(recipe, tmp_path_factory.mktemp("runs") / "of_three"))


def test_a_step_of_several_batches_is_finished(of_three, data, tmp_path, again):
    recipe = signalled(data, accumulated=3, max_steps=6, batch=6)
    run = RunFolder(tmp_path / "run")
    with pytest.raises(StoppedEarly, match="saved step 3"):
        fit(recipe, run.path)
    again(recipe, run.path)
    assert_same(of_three, run)


def test_a_run_that_is_to_stop_finishes_its_step(of_three, data, tmp_path, again):
    """After the first of three batches of step 5; then it goes on with no clip lost."""
    stop = {"class_path": "tests.training.callbacks.Stop", "init_args": {"batch": 12}}
    flags = {"callbacks": [stop], "accumulate_grad_batches": 3, "max_steps": 6}
    recipe = tiny_recipe(data, trainer=flags)
    run = RunFolder(fit(recipe, tmp_path / "run"))
    assert read_metadata(run.weights)["step"] == 5
    again(recipe, run.path)
    assert numbers(of_three) == without_validation(run, 4)


@pytest.mark.parametrize("array", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_slurm_queues_the_job_again(array, whole, data, tmp_path, slurm, again, monkeypatch):
    if array:
        monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "77")
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    job = "77_3" if array else "123"
    recipe = signalled(data, batch=9, number=signal.SIGUSR1)
    run = RunFolder(tmp_path / "run")
    with pytest.raises(StoppedEarly, match=f"saved step 10.*; SLURM job {job} was requeued"):
        fit(recipe, run.path, resume="auto")
    assert slurm.read_text() == f"requeue {job}\n"
    again(recipe, run.path)
    assert_same(whole, run)
    done = run.weights.read_bytes()
    assert again(recipe, run.path) == run.path  # a queue that is not told that all is done
    assert run.weights.read_bytes() == done


def test_slurm_is_not_asked_without_need(data, tmp_path, slurm, monkeypatch):
    """SIGTERM is how a job is cancelled or preempted: that is SLURM's to decide upon."""
    with pytest.raises(StoppedEarly, match=r"saved step 10; continue with `[^`]+`$"):
        fit(signalled(data, batch=9), tmp_path / "cancelled")
    assert not slurm.exists()
    monkeypatch.setenv("REFUSE", "1")
    with pytest.raises(StoppedEarly, match=r"saved step 10.*123 was not requeued: no 123"):
        fit(signalled(data, batch=9, number=signal.SIGUSR1), tmp_path / "refused")


def test_a_run_that_never_saved_starts_again(whole, data, tmp_path, again, monkeypatch):
    """Stopped while clips were encoded; it starts if it is resumed."""
    run = RunFolder(tmp_path / "run")

    def interrupted(*args, **kwargs):
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr("acwm_core.training.data.encode_windows", interrupted)
        with pytest.raises(
            StoppedEarly, match=f"before the first step; continue with `acwm fit resume={run.path}`"
        ):
            fit(tiny_recipe(data), run.path)
    assert run.recipe.exists()
    with pytest.raises(TrainingError, match="holds a run already"):
        fit(tiny_recipe(data), run.path)
    with pytest.raises(TrainingError, match=r"another recipe: training\.seed was 0, is 5"):
        again(tiny_recipe(data, training={"seed": 5}), run.path)
    again(tiny_recipe(data), run.path)
    assert_same(whole, run)
