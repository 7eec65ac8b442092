"""Clips per second from video shards and from latents, beside a plain WebDataset pipeline.

    python benchmarks/loading.py --size 64 --size 240 --episodes 48 --workers 0

Generates `push_cube` into a temporary folder, or reads ``--data FOLDER``. All ways load the same
windows in batches of 16, in one run on one machine, after one unmeasured pass that fills the
disk cache; what counts is their ratios.
"""

from __future__ import annotations

import argparse
import io
import random
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch.utils.data import DataLoader

from acwm_core.catalog import catalog
from acwm_core.data.dataset import ClipDataset, EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ResumableLoader
from acwm_core.data.shards import open_shard
from acwm_core.data.video import decode_planes
from acwm_core.data.windows import padded_video, window_actions

FRAMES, STRIDE, BATCH = 37, 4, 16


def decoder_alone(episodes: EpisodeDataset, clips: ClipDataset) -> int:
    """Decode every window from bytes in memory: what no loader in one process can beat."""
    shards = [open_shard(path) for path in sorted((episodes.path / "train").glob("*.tar"))]
    videos = [shard.read(place, "video.mkv") for shard in shards for place in range(len(shard))]
    started = time.perf_counter()
    for episode, start in clips.windows.tolist():
        decode_planes(videos[episode], start, start + FRAMES)
    return round(len(clips) / (time.perf_counter() - started))


def webdataset_loader(folder: Path, workers: int) -> Iterable[Any]:
    """What one writes with WebDataset alone: stream episodes, cut a random window, shuffle."""
    import webdataset

    def window(sample: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor]:
        actions = np.load(io.BytesIO(sample["actions.npy"]))
        start = random.randrange(0, max(1, len(actions) - FRAMES + 1), STRIDE)
        video = decode_planes(sample["video.mkv"], start, min(start + FRAMES, len(actions)))
        return (
            torch.from_numpy(padded_video(video, FRAMES)),
            torch.from_numpy(window_actions(actions, start, FRAMES)),
        )

    shards = [str(path) for path in sorted((folder / "train").glob("*.tar"))]
    pipeline = webdataset.WebDataset(shards, shardshuffle=len(shards), empty_check=False)
    return DataLoader(
        pipeline.shuffle(64).map(window),
        batch_size=BATCH,
        num_workers=min(workers, len(shards)),
    )


def clips_per_second(batches: Iterable[Any], passes: int) -> int:
    """Clips per second over some passes, after one that is not measured."""
    count = 0
    for number in range(passes + 1):
        if number == 1:
            started, count = time.perf_counter(), 0
        for batch in batches:
            first = next(iter(batch.values())) if isinstance(batch, dict) else batch[0]
            count += len(first)
    return round(count / (time.perf_counter() - started))


def measure(folder: Path, workers: int) -> list[tuple[str, int]]:
    """Rows of way and clips per second."""
    episodes = EpisodeDataset(folder, "train")
    clips = ClipDataset(episodes, frames=FRAMES, stride=STRIDE)
    codec = catalog().create("codec", "compact", weights="random")
    encode_windows(episodes, codec, frames=FRAMES, stride=STRIDE)
    latents = LatentClipDataset(episodes, codec.fingerprint(), frames=FRAMES, stride=STRIDE)
    loader: Callable[..., Any] = ResumableLoader
    return [
        ("plain WebDataset", clips_per_second(webdataset_loader(folder, workers), passes=4)),
        ("decoder alone, one process", decoder_alone(episodes, clips)),
        ("video", clips_per_second(loader(clips, batch_size=BATCH, workers=workers), passes=1)),
        (
            "latents",
            clips_per_second(loader(latents, batch_size=BATCH, workers=workers), passes=20),
        ),
    ]


def main() -> None:
    """Generate or read, measure, print one table per dataset."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", type=int, action="append", help="frame sizes; 64 and 240")
    parser.add_argument("--episodes", type=int, default=48)
    parser.add_argument("--workers", type=int, default=0, help="loader processes")
    parser.add_argument("--data", type=Path, action="append", help="use these data folders instead")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folders = arguments.data or []
        for size in [] if folders else arguments.size or [64, 240]:
            folders.append(Path(temporary, str(size)))
            generate(
                "push_cube",
                folders[-1],
                episodes={"train": arguments.episodes},
                size=size,
                shard_episodes=8,
            )
        for folder in folders:
            report(folder, measure(folder, arguments.workers), arguments.workers)


def report(folder: Path, rows: list[tuple[str, int]], workers: int) -> None:
    """Print clips per second and their ratio to plain WebDataset."""
    episodes = EpisodeDataset(folder, "train")
    height, width = episodes.card.environment.frame_size
    table = Table("way", "clips/s", "ratio", title=f"{height}×{width}, {workers} workers")
    for way, speed in rows:
        table.add_row(way, str(speed), f"{speed / rows[0][1]:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
