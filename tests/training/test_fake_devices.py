"""One process of 8 or 64, whose group is PyTorch's fake one: it hears nothing of the others.

So the numbers are wrong, but who takes which clips, how many steps there are, and what each process
holds are those of a real training.
"""

import contextlib
import multiprocessing
import os
from functools import partial

import pytest
import torch
from lightning.pytorch.callbacks import Callback
from torch import distributed
from torch._dynamo.utils import counters
from torch.nn.parallel import DistributedDataParallel

from acwm_core.training import fit as training
from acwm_core.training.fit import fit
from tests.tiny import tiny_recipe

NODE, STEPS = 8, 3
"""Devices of a node, and optimiser steps."""


class Facts(Callback):
    """Sends what a test asks about through a pipe."""

    pipe = None

    def __init__(self):
        self.places, self.held = [], {}

    def on_train_start(self, trainer, pl_module):
        if isinstance(model := trainer.strategy.model, DistributedDataParallel):
            model.register_comm_hook(None, unchanged)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.places.append(batch["positions"])

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        model = pl_module.world_model.model
        self.held = {name: [*local_of(each).shape] for name, each in model.named_parameters()}

    def on_train_end(self, trainer, pl_module):
        clips, graphs = trainer.datamodule.clips_per_step, counters["stats"]["unique_graphs"]
        self.pipe.send((trainer.global_step, clips, self.places, self.held, graphs))


def unchanged(state, bucket):
    """Gradients as they are; the fake group gives none to DDP."""
    done = torch.futures.Future()
    done.set_result(bucket.buffer())
    return done


def local_of(tensor):
    return tensor.to_local() if hasattr(tensor, "to_local") else tensor


def _train(pipe, data, folder, strategy, world, compiled, rank):
    from torch.testing._internal.distributed.fake_pg import FakeStore

    nodes, node = world // NODE, rank // NODE
    os.environ |= {
        **{"RANK": f"{rank}", "WORLD_SIZE": f"{world}", "LOCAL_RANK": f"{rank % NODE}"},
        **{"LOCAL_WORLD_SIZE": f"{NODE}", "GROUP_RANK": f"{node}", "TORCHELASTIC_RUN_ID": "fake"},
        **{"MASTER_ADDR": "localhost", "MASTER_PORT": "1"},
    }
    counters.clear()  # of the process that this one is forked from
    distributed.init_process_group("fake", rank=rank, world_size=world, store=FakeStore())
    # A fake group would deliver garbage as objects, and has no gloo beside it.
    distributed.broadcast_object_list = lambda *_, **__: None
    distributed.new_group = lambda *_, **__: distributed.group.WORLD
    training.first_decides = contextlib.nullcontext  # nobody else is there to hear it
    training.callbacks.LastCheckpoint._save = lambda *_: None  # nobody sends the other shards
    training._check_saved = lambda *_: None
    # In one piece or not at all, and without the minutes that a fast program takes.
    torch.compile = partial(torch.compile, fullgraph=True, backend="aot_eager")
    Facts.pipe = pipe
    flags = {"devices": NODE, "num_nodes": nodes, "strategy": strategy, "max_steps": STEPS}
    flags |= {"accumulate_grad_batches": 2, "precision": "32-true"}
    flags |= {"callbacks": [{"class_path": "tests.training.test_fake_devices.Facts"}]}
    fit(
        tiny_recipe(
            data,
            model={"width": 36, "depth": 1},
            data={"batch_size": 2},
            training={"validate_every_n_steps": 100, "compile": compiled},
            trainer=flags,
        ),
        folder,
    )


def of_rank(data, folder, *job):
    """What `Facts` sends of one process of a training."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_train, args=(there, data, folder, *job))
    process.start()
    there.close()
    try:
        return here.recv()
    finally:
        process.join(60)


def part(rows, parts, number):
    """How many of `rows` the part of this number holds."""
    cut = torch.arange(rows).chunk(parts)
    return len(cut[number]) if number < len(cut) else 0


@pytest.mark.parametrize(
    ("strategy", "world", "compiled", "ranks", "parts"),
    [
        ("ddp", 8, False, (0, 5), 1),
        ("ddp", 64, False, (63,), 1),
        ("fsdp", 8, False, (0, 7), 8),
        ("fsdp", 64, False, (0, 41), 64),
        ("hsdp", 8, False, (3,), 8),
        ("hsdp", 64, False, (0, 41), 8),
        *(
            pytest.param(*compiled, marks=pytest.mark.ci)
            for compiled in (("ddp", 8, True, (5,), 1), ("hsdp", 64, True, (41,), 8))
        ),
    ],
)
def test_every_process_takes_its_part(strategy, world, compiled, ranks, parts, data, tmp_path):
    """Of the clips of each step, and of the weights; all do as many steps. Compiled, too."""
    for rank in ranks:
        run = tmp_path / f"{rank}"
        job = strategy, world, compiled, rank
        steps, clips, places, held, graphs = of_rank(data, run, *job)
        assert graphs == (1 if compiled else 0)
        assert steps == STEPS
        assert clips == 2 * 2 * world
        batches = [
            range(2 * (world * n + rank), 2 * (world * n + rank) + 2) for n in range(2 * STEPS)
        ]
        assert places == [tuple(batch) for batch in batches]
        for name, rows in {"enter.weight": 36, "blocks.0.0.weight": 72, "leave.bias": 3}.items():
            assert held[name][0] == part(rows, parts, rank % parts), name
