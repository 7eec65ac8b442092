"""Clips per second from video shards and latents, compared with common ways and the hardware.

    python benchmarks/loading.py --size 64 --size 240 --episodes 48
    python benchmarks/loading.py --size 64 --workers 0      the default of training

Generates `push_cube` into a temporary folder, or reads ``--data FOLDER``. All ways load clips of 37
frames in batches of 16, in random order, with a worker per core, in one run on one machine. They
are measured after a few batches that start the workers and fill the disk cache. Only the ratios
matter.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from loading_ways import Hdf5Windows, Mp4Windows, batches_of, webdataset_loader
from rich.console import Console
from rich.table import Table

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.data.shards import open_shard
from acwm_core.data.video import decode_into
from acwm_core.plugins import catalog

FRAMES, STRIDE, BATCH = 37, 4, 16
GZIP = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
BASELINE = "plain WebDataset"


@dataclass(frozen=True)
class Row:
    """A line of the table: name of the way, clips per second, bytes on disk, and a remark."""

    way: str
    speed: float
    size: int
    remark: str = ""


def clips_per_second(loader: Iterable[Any], seconds: float) -> float:
    """The rate over some seconds, after enough batches to start every worker."""
    batches = batches_of(loader)
    for _ in range(4 * max(1, os.cpu_count() or 1)):
        next(batches)
    started, count = time.perf_counter(), 0
    while (passed := time.perf_counter() - started) < seconds:
        count += next(batches)
    return count / passed


def decoder_speed(folder: Path, processes: int, seconds: float) -> float:
    """Clips per second that `processes` processes decode from memory: the limit of any loader."""
    context = multiprocessing.get_context("spawn")
    together = context.Barrier(processes)
    rates: Any = context.Queue()
    workers = [
        context.Process(target=_decode_alone, args=(folder, number, seconds, together, rates))
        for number in range(processes)
    ]
    for worker in workers:
        worker.start()
    total = sum(rates.get() for _ in workers)
    for worker in workers:
        worker.join()
    return total


def _decode_alone(folder: Path, number: int, seconds: float, together: Any, rates: Any) -> None:
    episodes = EpisodeDataset(folder, "train")
    windows = ClipDataset(episodes, frames=FRAMES, stride=STRIDE).windows
    shards = [open_shard(path) for path in sorted((folder / "train").glob("*.tar"))]
    videos = [shard.read(place, "video.mkv") for shard in shards for place in range(len(shard))]
    target = np.empty((FRAMES, 3, *episodes.card.environment.frame_size), np.uint8)
    order = np.random.default_rng(number)
    together.wait()
    started, count = time.perf_counter(), 0
    while (passed := time.perf_counter() - started) < seconds:
        episode, start = windows[order.integers(len(windows))].tolist()
        held = min(FRAMES, episodes.lengths[episode] - start)
        decode_into(target[:held], videos[episode], start)
        count += 1
    rates.put(count / passed)


def copy_speed(seconds: float) -> float:
    """Bytes per second that one process copies between two large arrays."""
    source, target = np.ones(2**25), np.zeros(2**25)
    started, count = time.perf_counter(), 0
    while (passed := time.perf_counter() - started) < seconds:
        np.copyto(target, source)
        count += source.nbytes
    return count / passed


def video_rows(folder: Path, scratch: Path, workers: int, seconds: float) -> list[Row]:
    """Measure clips as video."""
    episodes = EpisodeDataset(folder, "train")
    clips = ClipDataset(episodes, frames=FRAMES, stride=STRIDE)
    loading = {"batch_size": BATCH, "num_workers": workers}
    tars = sum(path.stat().st_size for path in (folder / "train").glob("*.tar"))
    streamed = webdataset_loader(episodes, FRAMES, STRIDE, **loading)
    rows = [Row(BASELINE, clips_per_second(streamed, seconds), tars, "the same tars")]
    others = {
        "HDF5, gzip": (Hdf5Windows.write(clips, scratch / "gzip.h5", **GZIP), "chunk per frame"),
        "HDF5, raw": (Hdf5Windows.write(clips, scratch / "raw.h5"), "chunk per frame"),
        "MP4, like LeRobot": (Mp4Windows.write(clips, scratch / "all.mp4"), "lossy, H.264, g=2"),
    }
    for way, (windows, remark) in others.items():
        speed = clips_per_second(windows.loader(**loading), seconds)
        rows.append(Row(way, speed, windows.path.stat().st_size, remark))
    alone = decoder_speed(folder, max(1, workers), seconds)
    rows.append(Row("decoder alone", alone, tars, f"{max(1, workers)} processes"))
    ours = ClipLoader(clips, ClipSampler(len(clips), batch_size=BATCH), workers=workers)
    speed = clips_per_second(ours, seconds)
    return [*rows, Row("acwm, video", speed, tars, f"{speed / alone:.0%} of the decoder")]


def latent_rows(folder: Path, workers: int, seconds: float) -> list[Row]:
    """Measure clips as latents, loaded in this process and by workers."""
    episodes = EpisodeDataset(folder, "train")
    codec = catalog().create("codec", "compact", weights="random")
    windows = {"frames": FRAMES, "stride": STRIDE}
    kept = encode_windows(episodes, codec, **windows)
    latents = LatentClipDataset(episodes, codec.fingerprint(), **windows)
    clip = sum(np.asarray(value).nbytes for value in latents[0].values())
    copies, size = copy_speed(seconds), sum(path.stat().st_size for path in kept.glob("*.npy"))
    rows: list[Row] = []
    for number in sorted({0, workers}):
        loader = ClipLoader(latents, ClipSampler(len(latents), batch_size=BATCH), workers=number)
        speed = clips_per_second(loader, seconds)
        share = speed * clip / copies
        remark = f"{clip / 1e3:.0f} kB a clip: {share:.0%} of memcpy's {copies / 1e9:.1f} GB/s"
        rows.append(Row(f"acwm, latents, {number} workers", speed, size, remark))
    return rows


def report(folder: Path, rows: list[Row], workers: int) -> None:
    """Print clips per second and their ratio to plain WebDataset."""
    episodes = EpisodeDataset(folder, "train")
    height, width = episodes.card.environment.frame_size
    title = f"{height}×{width}, {len(episodes)} episodes, {workers} workers"
    table = Table("way", "clips/s", "ratio", "MB", "", title=title)
    base = next(row.speed for row in rows if row.way == BASELINE)
    for row in rows:
        ratio = f"{row.speed / base:.2f}"
        table.add_row(row.way, f"{row.speed:,.0f}", ratio, f"{row.size / 1e6:.1f}", row.remark)
    Console(width=100).print(table)


def main() -> None:
    """Generate or read the data, measure, and print one table per dataset."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", type=int, action="append", help="frame sizes; 64 and 240")
    parser.add_argument("--episodes", type=int, default=48)
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="loader processes")
    parser.add_argument("--seconds", type=float, default=10.0, help="per way")
    parser.add_argument("--data", type=Path, action="append", help="use these data folders instead")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folders = arguments.data or []
        for size in [] if folders else arguments.size or [64, 240]:
            folders.append(Path(temporary, str(size)))
            counts = {"train": arguments.episodes}
            generate("push_cube", folders[-1], episodes=counts, size=size, shard_episodes=8)
        for number, folder in enumerate(folders):
            scratch = Path(temporary, f"ways-{number}")
            scratch.mkdir()
            rows = video_rows(folder, scratch, arguments.workers, arguments.seconds)
            rows += latent_rows(folder, arguments.workers, arguments.seconds)
            report(folder, rows, arguments.workers)


if __name__ == "__main__":
    main()
