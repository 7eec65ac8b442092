"""Training in processes of its own: SIGKILL, and two ranks that Lightning starts."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from acwm_core.training.fit import fit
from acwm_core.training.run import load_run, read_metadata
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.runs import assert_same, numbers

ROOT = Path(__file__).parents[2]


def train(data, run, /, *, resume="", spared=False, **sections):
    command = [sys.executable, "-m", "tests.training.train_tiny"]
    arguments = [str(data), str(run), json.dumps(sections), *([str(resume)] if resume else [])]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"} | ({"SPARED": "1"} if spared else {})
    return subprocess.run(
        [*command, *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def callback(name, **init_args):
    return {"class_path": f"tests.training.callbacks.{name}", "init_args": init_args}


def test_killed_by_sigkill_it_resumes_on_the_same_curve(whole, data, tmp_path, monkeypatch):
    recipe = tiny_recipe(data, trainer={"callbacks": [callback("Die", batch=10)]})
    child = os.fork()
    if not child:
        try:
            fit(recipe, tmp_path / "run")
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    monkeypatch.setenv("SPARED", "1")
    assert_same(whole, RunFolder(fit(recipe, "", resume=tmp_path / "run")))


TWO = {"devices": 2, "strategy": "ddp"}


@pytest.mark.slow
def test_two_ranks_take_the_clips_of_one_and_agree(data, tmp_path):
    """Two ranks with batches of 2 see, step by step, the clips of one with batches of 4."""
    seen = {}
    for name, flags, batch_size in (("one", {}, 4), ("two", TWO, 2)):
        folder = tmp_path / f"seen-{name}"
        folder.mkdir()
        flags = {**flags, "callbacks": [callback("Witness", folder=str(folder))]}
        run = tmp_path / name
        done = train(data, run, trainer=flags, data={"batch_size": batch_size})
        assert done.returncode == 0, done.stderr
        ranks = [
            [json.loads(line) for line in file.read_text().splitlines()]
            for file in sorted(folder.iterdir())
        ]
        seen[name] = [[*itertools.chain(*step)] for step in zip(*ranks, strict=True)]
    assert len(seen["one"]) == 16
    assert seen["one"] == seen["two"]
    assert read_metadata(RunFolder(tmp_path / "two").weights)["step"] == 16
    load_run(tmp_path / "two")


@pytest.mark.slow
def test_two_ranks_resume_exactly(data, tmp_path):
    recipe = {"trainer": {**TWO, "callbacks": [callback("Die", batch=10)]}}
    whole, run = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "run")
    assert train(data, whole.path, spared=True, **recipe).returncode == 0
    assert train(data, run.path, **recipe).returncode != 0
    done = train(data, "", resume=run.path, spared=True, **recipe)
    assert done.returncode == 0, done.stderr
    assert_same(whole, run)


def slurm(rank, port):
    """What `srun` tells a process of two on one node."""
    facts = {"JOB_ID": "1", "JOB_NAME": "job", "NTASKS": "2", "NTASKS_PER_NODE": "2"}
    facts |= {"NODEID": "0", "NNODES": "1", "PROCID": f"{rank}", "LOCALID": f"{rank}"}
    return {
        **{f"SLURM_{name}": value for name, value in facts.items()},
        **{"MASTER_ADDR": "localhost", "MASTER_PORT": f"{port}", "OMP_NUM_THREADS": "1"},
    }


@pytest.mark.slow
def test_what_the_first_process_refuses_ends_the_others_too(data, tmp_path):
    """Only the first one sees that there is nothing to resume; then both train another run."""
    flags = {"trainer": {**TWO, "max_steps": 2}}
    jobs = [
        {"run": "", "resume": str(tmp_path / "nowhere"), "sections": flags},
        {"run": str(tmp_path / "run"), "sections": flags},
    ]
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tests.training.train_many", str(data), json.dumps(jobs)]
    started = [
        subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **slurm(rank, port)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        printed = [process.communicate(timeout=300)[0] for process in started]
    finally:
        for process in started:
            process.kill()
    first, second = (json.loads(each.splitlines()[-1]) for each in printed)
    assert first[0].startswith("2: there is nothing to resume")
    assert second[0] == "2"
    assert (first[1], second[1]) == (None, "0")
    assert read_metadata(RunFolder(tmp_path / "run").weights)["step"] == 2


@pytest.mark.slow
def test_a_nan_on_one_rank_stops_all_with_one_sentence(data, tmp_path):
    flags = {**TWO, "callbacks": [callback("Poison", batch=5, rank=1)]}
    done = train(data, tmp_path / "run", trainer=flags)
    assert done.returncode == 2
    assert done.stderr.count("error:") == 1
    assert "not finite in step 5" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["ddp", "fsdp"])
def test_a_signal_stops_the_processes_that_lightning_starts(strategy, data, tmp_path):
    """One sentence, the exit code for "try again", and the same run by the same command."""
    flags = {**TWO, "strategy": strategy, "callbacks": [callback("Signal", batch=9)]}
    whole, run = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "run")
    assert train(data, whole.path, spared=True, trainer=flags).returncode == 0
    done = train(data, run.path, resume="auto", trainer=flags)
    assert done.returncode == 75, done.stderr
    assert done.stderr.count("error: ") == 1
    assert "stopped by SIGTERM, saved step 10; continue with `acwm fit resume=" in done.stderr
    assert "Traceback" not in done.stderr
    done = train(data, run.path, resume="auto", spared=True, trainer=flags)
    assert done.returncode == 0, done.stderr
    assert numbers(run) == numbers(whole)
    assert run.weights.read_bytes() == whole.weights.read_bytes()
