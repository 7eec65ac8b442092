"""Processes that read a dataset as training does: as ranks of a group, or to be killed.

``python reading.py DATA FOLDER SEED KILLS PLANS`` starts readers on DATA one after another and
kills each at a random moment by SIGKILL, KILLS times, then lets one finish. PLANS is a JSON list of
``[ranks, batch size, workers]``, of which the readers take turns.
"""

import contextlib
import itertools
import json
import os
import random
import signal
import sys
import time
import zlib
from pathlib import Path

import torch
import torch.distributed as dist

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.loader import ClipLoader, ClipSampler

CLIPS = 120
"""How many a reader that is not killed reads in all."""


def clips_of(data):
    """The clips that all readers read."""
    return ClipDataset(EpisodeDataset(data, "train"), frames=9, stride=4)


def fingerprints(batch):
    """A checksum of each clip, by which it is known."""
    pairs = zip(batch["video"], batch["actions"], strict=True)
    return [zlib.crc32(v.numpy().tobytes(), zlib.crc32(a.numpy().tobytes())) for v, a in pairs]


def loaders_of(data, ranks, batch_size, workers):
    """A loader per rank."""
    clips = clips_of(data)
    settings = {"batch_size": batch_size, "seed": 7, "world_size": ranks}
    samplers = [ClipSampler(len(clips), rank=rank, **settings) for rank in range(ranks)]
    loaders = [ClipLoader(clips, sampler, workers=workers) for sampler in samplers]
    for loader in loaders:
        if workers:  # spawned ones would import torch for seconds
            loader._loader.multiprocessing_context = "fork"
    return loaders


def rank_main(rank, ranks, workers, data, folder):
    """One rank of a real process group; a rank that takes fewer steps would hang the others."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", f"file://{folder}/group", rank=rank, world_size=ranks)
    clips = clips_of(data)
    sampler = ClipSampler(len(clips), batch_size=3, seed=7, rank=rank, world_size=ranks)
    loader = ClipLoader(clips, sampler, workers=workers)
    steps = []
    for batch in itertools.islice(loader, 2 * CLIPS // (3 * ranks)):
        everyone = [None] * ranks
        dist.all_gather_object(everyone, fingerprints(batch))
        steps.append(everyone)
    Path(folder, f"rank-{rank}.json").write_text(json.dumps(steps))
    dist.barrier()
    dist.destroy_process_group()


def read(data, folder, ranks, batch_size, workers):
    """Go on from the last saved position; log each clip with its place in the stream."""
    loaders = loaders_of(data, ranks, batch_size, workers)
    saved = folder / "state.json"
    if saved.exists():
        for loader in loaders:
            loader.order.position = int(saved.read_text())
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    place = loaders[0].order.position
    for step, batches in enumerate(zip(*loaders, strict=True)):
        for batch in batches:
            for clip in fingerprints(batch):
                os.write(log, f"{place} {clip}\n".encode())
                place += 1
        if step % 3 == 2:
            saved.with_suffix(".new").write_text(str(loaders[0].order.position))
            saved.with_suffix(".new").replace(saved)
        if place >= CLIPS:
            return


def start(data, folder, plan):
    """A reader in a process of its own, forked from this one, which has all imported."""
    child = os.fork()
    if child:
        return child
    os.setsid()
    try:
        read(data, folder, *plan)
    finally:
        os._exit(0 if sys.exc_info()[0] is None else 1)


def lines(folder):
    """How many clips were logged."""
    log = folder / "log"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def killed(child, folder, rng):
    """Kill `child` after a random number of further clips, at a random moment from then on.

    Returns False if it ended before.
    """
    before, wanted = lines(folder), rng.randrange(40)
    while lines(folder) - before < wanted:
        if os.waitpid(child, os.WNOHANG)[0]:
            return False
        time.sleep(0.0005)
    time.sleep(rng.uniform(0, 0.01))
    os.kill(child, signal.SIGKILL)
    died = os.WIFSIGNALED(os.waitpid(child, 0)[1])
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # its workers would notice within seconds
    return died


def main(data, folder, seed, kills, plans):
    """Kill and resume; print how many readers died and whether the last one finished."""
    torch.set_num_threads(1)
    rng, turn, died = random.Random(int(seed)), 0, 0
    plans = json.loads(plans)
    run, number = Path(folder, "0"), 0
    run.mkdir()
    while died < int(kills):
        child = start(data, run, plans[turn % len(plans)])
        turn += 1
        if killed(child, run, rng):
            died += 1
        else:  # it reached the end: another run
            number += 1
            run = Path(folder, str(number))
            run.mkdir()
    last = os.waitpid(start(data, run, plans[turn % len(plans)]), 0)[1]
    print(json.dumps({"died": died, "runs": number + 1, "last": last}))


if __name__ == "__main__":
    main(*sys.argv[1:])
