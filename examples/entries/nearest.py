"""Nearest neighbour: the training video whose beginning and actions are most similar.

An entry for the ACWM-Phys benchmark that learns nothing; it imports nothing of acwm.

    python nearest.py --data data/push_cube --tasks tasks --out predictions
"""

from __future__ import annotations

import argparse
import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np

COARSE = 8
"""Pixels per side of the blocks in which first frames are compared, so that places count."""


def training_episodes(data: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Video `[T, H, W, 3]` uint8 and actions `[T, A]` of each training episode."""
    for shard in sorted((data / "train").glob("*.tar")):
        with tarfile.open(shard) as tar:
            files = {
                member.name: tar.extractfile(member).read() for member in tar if member.isfile()
            }
        for name in sorted(name for name in files if name.endswith(".video.mkv")):
            actions = files[name.replace(".video.mkv", ".actions.npy")]
            yield iio.imread(files[name], extension=".mkv"), np.load(io.BytesIO(actions))


def coarse(frames: np.ndarray) -> np.ndarray:
    """Frames `[N, H, W, 3]` averaged over blocks, in [0, 1], `[N, …]`."""
    count, height, width, _ = frames.shape
    rows, columns = height // COARSE, width // COARSE
    cut = frames[:, : rows * COARSE, : columns * COARSE].astype(np.float32) / 255
    return cut.reshape(count, rows, COARSE, columns, COARSE, 3).mean((2, 4)).reshape(count, -1)


def lengthened(array: np.ndarray, length: int) -> np.ndarray:
    """The first rows; if there are too few, the last one is repeated."""
    rows = np.minimum(np.arange(length), len(array) - 1)
    return array[rows]


class Neighbours:
    """All training episodes in memory.

    Args:
        data: a dataset of the benchmark.
        looks: weight of the difference of first frames beside that of actions; each counts in
            its standard deviations.
    """

    def __init__(self, data: Path, looks: float) -> None:
        episodes = list(training_episodes(data))
        self.videos = [video for video, _ in episodes]
        self.actions = [actions for _, actions in episodes]
        rows = np.concatenate(self.actions)
        self.scale = rows.std(0) + 1e-6
        self.starts = coarse(np.stack([video[0] for video in self.videos]))
        self.spread = self.starts.std(0).mean() + 1e-6
        self.looks = looks

    def predict(self, given: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The video of the nearest episode after the given frames."""
        length = len(actions)
        moves = np.stack([lengthened(each, length)[:-1] for each in self.actions])
        by_actions = (((moves - actions[:-1]) / self.scale) ** 2).mean((1, 2))
        by_looks = (((self.starts - coarse(given[:1])) / self.spread) ** 2).mean(1)
        nearest = int(np.argmin(by_actions + self.looks * by_looks))
        return np.concatenate([given, lengthened(self.videos[nearest], length)[len(given) :]])


def main() -> None:
    """Predict every task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="dataset with the training split")
    parser.add_argument("--tasks", type=Path, required=True, help="folder of the tasks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the predictions")
    parser.add_argument("--looks", type=float, default=1.0, help="weight of the first frame")
    options = parser.parse_args()
    neighbours = Neighbours(options.data, options.looks)
    for line in (options.tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        given = np.stack([iio.imread(options.tasks / name) for name in task["images"]])
        actions = np.load(options.tasks / task["actions"])["actions"]
        folder = options.out / task["id"]
        folder.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(neighbours.predict(given, actions)):
            iio.imwrite(folder / f"{number:04d}.png", frame)
    facts = "name: Nearest neighbour\nparameters: 0\ndata: the training split\n"
    (options.out / "entry.yaml").write_text(facts)


if __name__ == "__main__":
    main()
