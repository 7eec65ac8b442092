"""A model that acwm trained: a run folder, or the name of a model that ships.

An entry for the ACWM-Phys benchmark by acwm's Python interface; it reads the tasks like any other
program.

    python trained.py --run runs/push_cube_small --tasks tasks --out predictions
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch

import acwm


def as_pixels(frames: np.ndarray) -> torch.Tensor:
    """Frames `[T, H, W, 3]` uint8 as `[1, T, 3, H, W]` in [0, 1]."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2)[None] / 255


def main() -> None:
    """Predict every task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", required=True, help="run folder, or name of a shipped model")
    parser.add_argument("--tasks", type=Path, required=True, help="folder of the tasks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the predictions")
    parser.add_argument("--name", help="name of the entry; by default that of the run")
    options = parser.parse_args()
    model = acwm.load(options.run).world_model
    for line in (options.tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        given = np.stack([iio.imread(options.tasks / name) for name in task["images"]])
        actions = np.load(options.tasks / task["actions"])["actions"]
        rows = torch.from_numpy(actions).float()[None]
        video = model.rollout(as_pixels(given), rows, seeds=[task["seed"]])[0]
        pixels = (255 * video.permute(0, 2, 3, 1)).round().byte().numpy()
        folder = options.out / task["id"]
        folder.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(pixels):
            iio.imwrite(folder / f"{number:04d}.png", frame)
    count = sum(weight.numel() for weight in model.parameters())
    facts = {"name": options.name or Path(options.run).name, "parameters": count}
    (options.out / "entry.yaml").write_text(json.dumps(facts | {"data": "the training split"}))


if __name__ == "__main__":
    main()
