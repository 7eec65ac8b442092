"""Processes that train together, by DDP, FSDP and HSDP, against one; killed, stopped, resumed."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from acwm_core.errors import TrainingError
from acwm_core.training.checkpoints import read_whole
from acwm_core.training.fit import fit
from acwm_core.training.layers import state_memory
from acwm_core.training.run import load_run, read_metadata
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe
from tests.training.runs import numbers

ROOT = Path(__file__).parents[2]

MODEL = {"model": {"depth": 2, "dropout": 0.0}}
"""Without dropout, which alone depends on how a step is cut into batches."""


def sections(batch_size, *, training=None, **trainer):
    trainer = {"precision": "32-true", "gradient_clip_val": 0.5, **trainer}
    sampling = {"sample_every_n_steps": 8, "sample_videos": 1}
    data = {"batch_size": batch_size}
    return {**MODEL, "data": data, "trainer": trainer, "training": {**sampling, **(training or {})}}


def two(strategy, batch_size=2, **more):
    return sections(batch_size, devices=2, strategy=strategy, **more)


def callback(name, **init_args):
    return {"class_path": f"tests.training.callbacks.{name}", "init_args": init_args}


def in_processes(data, jobs, nodes=1):
    """Run jobs of `train_many` on two ranks per node, as torchrun would start them."""
    store = torch.distributed.TCPStore("localhost", 0, is_master=True, wait_for_workers=False)
    common = {"MASTER_ADDR": "localhost", "MASTER_PORT": str(store.port)}
    common |= {"WORLD_SIZE": f"{2 * nodes}"}
    common |= {"TORCHELASTIC_USE_AGENT_STORE": "True", "TORCHELASTIC_RESTART_COUNT": "0"}
    common |= {"TORCHELASTIC_RUN_ID": "test", "OMP_NUM_THREADS": "1", "LOCAL_WORLD_SIZE": "2"}
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.training.train_many", str(data), json.dumps(jobs)],
            cwd=ROOT,
            env={**os.environ, **common, **ranks},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for ranks in (
            {"RANK": f"{rank}", "LOCAL_RANK": f"{rank % 2}", "GROUP_RANK": f"{rank // 2}"}
            for rank in range(2 * nodes)
        )
    ]
    try:
        return [(process, *process.communicate(timeout=600)) for process in started]
    finally:
        for process in started:
            process.kill()


def weights(run: RunFolder):
    return read_whole(run.last_checkpoint)["state_dict"]


def assert_same(one: RunFolder, other: RunFolder):
    """The same to the last bit: numbers, weights, averages and what the optimiser remembers."""
    assert numbers(one) == numbers(other)
    first, second = (read_whole(run.last_checkpoint) for run in (one, other))
    for part in ("state_dict", "optimizer_states", "lr_schedulers"):
        torch.testing.assert_close(first[part], second[part], rtol=0, atol=0)


def assert_close(one: RunFolder, other: RunFolder):
    """The same but for the order in which floats were added."""
    first, second = weights(one), weights(other)
    torch.testing.assert_close(first, second, rtol=1e-3, atol=1e-4)
    ours, theirs = numbers(one), numbers(other)
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        assert float(value) == pytest.approx(float(theirs[key]), rel=1e-3), key


CONSTANT = {"schedule": "constant"}
"""A schedule that does not depend on how long the training is to be."""

JOBS = {
    "ddp": two("ddp"),
    "fsdp": two("fsdp"),
    "stopped": two("fsdp", callbacks=[callback("Signal", batch=9, rank=1)]),
    "poisoned": two("fsdp", callbacks=[callback("Poison", batch=5, rank=1)]),
}
"""Recipes of runs in two processes, all of which take 4 clips per step."""

MORE_JOBS = {
    "killed": two("fsdp", callbacks=[callback("Die", batch=10)]),
    "recomputed": two(
        "fsdp", 1, accumulate_grad_batches=2, training={"activation_checkpointing": True}
    ),
    "scattered": two("fsdp", 1, accumulate_grad_batches=2, training=CONSTANT),
    "gathered": two("fsdp", max_steps=7, training=CONSTANT),
}
"""More of them, for `make test-all`."""


def job(runs, name, *, resume=False, weighed=False):
    """A job of `train_many`; a resumed one is spared what stopped it."""
    path, words = runs[name].path, {**JOBS, **MORE_JOBS}[name]
    if weighed:
        folder = path.with_name(f"memory-{name}")
        folder.mkdir()
        weigh = callback("Weigh", folder=str(folder))
        words = {**words, "trainer": {**words["trainer"], "callbacks": [weigh]}}
    resumed = str(path) if resume else None
    return {"run": str(path), "sections": words, "resume": resumed, "spared": resume}


def outcomes(data, jobs, nodes=1):
    ended = in_processes(data, jobs, nodes)
    assert not any(process.returncode for process, *_ in ended), "".join(e for *_, e in ended)
    return json.loads(ended[0][1].splitlines()[-1])


@pytest.fixture(scope="module")
def runs(data, tmp_path_factory):
    """Runs by name: `one` by one device, and those of `JOBS`, finished but for the last."""
    folder = tmp_path_factory.mktemp("runs")
    made = {name: RunFolder(folder / name) for name in ("one", "constant", *JOBS, *MORE_JOBS)}
    fit(tiny_recipe(data, **sections(4)), made["one"].path)
    jobs = [job(made, name, weighed=True) for name in ("ddp", "fsdp")]
    jobs += [job(made, "stopped"), job(made, "stopped", resume=True), job(made, "poisoned")]
    *others, poisoned = outcomes(data, jobs)
    command = f"`acwm fit resume={made['stopped'].path} --trust-recipe`"
    stopped = f"75: stopped by SIGTERM, saved step 10; continue with {command}"
    assert others == [None, None, stopped, None]
    assert poisoned.startswith("2: the loss or its gradient is not finite in step 5 (")
    return made


@pytest.fixture(scope="module")
def more_runs(runs, data):
    """With `constant` by one device, and those of `MORE_JOBS`.

    `scattered` was begun by one device; `gathered` is begun by two and ends after 7 steps.
    """
    fit(tiny_recipe(data, **sections(4, training=CONSTANT)), runs["constant"].path)
    begun = sections(4, max_steps=7, training=CONSTANT)
    fit(tiny_recipe(data, **begun), runs["scattered"].path)
    killed = in_processes(data, [job(runs, "killed")])
    assert -signal.SIGKILL in [process.returncode for process, *_ in killed]
    jobs = [job(runs, name, resume=True) for name in ("killed", "scattered")]
    jobs += [job(runs, name) for name in ("recomputed", "gathered")]
    assert outcomes(data, jobs) == [None] * 4
    return runs


@pytest.mark.ci
@pytest.mark.parametrize("name", ["ddp", "fsdp"])
def test_two_processes_train_as_one(name, runs):
    """Weights, averages and all that is logged."""
    assert_close(runs["one"], runs[name])


@pytest.mark.slow
def test_layers_that_are_computed_again_train_the_same(more_runs):
    assert_close(more_runs["one"], more_runs["recomputed"])


@pytest.mark.ci
def test_sharded_runs_resume_exactly(runs):
    """After a SIGTERM that one of the two received."""
    assert_same(runs["fsdp"], runs["stopped"])


@pytest.mark.slow
def test_killed_sharded_runs_resume_exactly(more_runs):
    """After SIGKILL in both."""
    assert_same(more_runs["fsdp"], more_runs["killed"])


@pytest.mark.parametrize(("name", "parts"), [("ddp", 1), ("fsdp", 2)])
def test_each_process_holds_what_is_counted(name, parts, runs):
    """`state_memory` against the tensors of both ranks; the first has the larger part."""
    folder = runs[name].path.with_name(f"memory-{name}")
    first, second = (json.loads((folder / f"rank-{r}.json").read_text()) for r in (0, 1))
    counted = state_memory(load_run(runs[name].path).world_model, parts)
    gathered = counted.pop("gathered")
    assert first == counted
    assert (second == counted) == (name == "ddp")
    assert sum(second.values()) > 0.8 * sum(first.values())
    assert (gathered > 0) == (name == "fsdp")


def test_each_process_writes_its_part(runs):
    parts = sorted(runs["fsdp"].last_checkpoint.glob("*.distcp"))
    assert [part.name for part in parts] == ["__0_0.distcp", "__1_0.distcp"]
    sizes = [part.stat().st_size for part in parts]
    assert max(sizes) < 2 * min(sizes)
    assert not list(runs["fsdp"].checkpoints.glob(".*"))  # what was being written, or is outdated
    assert runs["ddp"].last_checkpoint.is_file()


def test_a_nan_on_one_process_keeps_the_last_good_checkpoint(runs):
    checkpoint = read_whole(runs["poisoned"].last_checkpoint)
    assert checkpoint["global_step"] == 3
    assert all(value.isfinite().all() for value in checkpoint["state_dict"].values())


def test_the_saved_model_is_one_file_of_the_averages(runs):
    run = runs["fsdp"]
    assert read_metadata(run.weights)["step"] == 16
    saved, averaged = load_run(run.path).world_model.state_dict(), weights(run)
    for name in ("model.enter.weight", "model.blocks.1.2.bias", "conditioner.embed.weight"):
        assert torch.equal(saved[name], averaged[f"averaged.{name}"])
        assert not torch.equal(saved[name], averaged[f"world_model.{name}"])
    assert [gif.name for gif in sorted(run.samples.iterdir())] == [
        "step-0000008.gif",
        "step-0000016.gif",
    ]


@pytest.mark.slow
def test_a_run_moves_to_other_devices(more_runs, data):
    """From one to two with sharded weights and smaller batches, and from two to one."""
    runs = more_runs
    assert_close(runs["constant"], runs["scattered"])
    whole = sections(4, training=CONSTANT)
    moved = runs["gathered"]
    with pytest.raises(TrainingError, match=r"takes 4 clips.*product is 4"):
        fit(tiny_recipe(data, **sections(3, training=CONSTANT)), "", resume=moved.path)
    fit(tiny_recipe(data, **whole), "", resume=moved.path)
    assert moved.last_checkpoint.is_file()
    assert_close(runs["constant"], moved)


@pytest.mark.slow
def test_nodes_with_copies_of_shards_train_as_one_device(runs, data, tmp_path):
    """Two nodes of two processes; also after a SIGTERM that one of the four received."""
    whole, stopped = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "stopped")
    flags = {"devices": 2, "num_nodes": 2, "strategy": "hsdp"}
    begun = sections(1, **flags, callbacks=[callback("Signal", batch=9, rank=3)])
    resumed = {"resume": str(stopped.path), "spared": True}
    jobs = [
        {"run": str(whole.path), "sections": sections(1, **flags), "resume": None},
        {"run": str(stopped.path), "sections": begun, "resume": None},
        {"run": str(stopped.path), "sections": begun, **resumed},
    ]
    first, second, third = outcomes(data, jobs, nodes=2)
    assert (first, third) == (None, None)
    assert second.startswith("75: stopped by SIGTERM, saved step 10")
    assert len(list(whole.last_checkpoint.glob("*.distcp"))) == 4
    assert_close(runs["one"], whole)
    assert_same(whole, stopped)
