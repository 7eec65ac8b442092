"""A convolutional predictor of the next frame, trained by squared error, as SimVP is.

An entry for the ACWM-Phys benchmark in plain PyTorch; it imports nothing of acwm. SimVP (Gao et
al. 2022, arXiv 2206.05099) has an encoder, a translator of Inception blocks in the middle and a
decoder, of convolutions alone. Here it predicts one frame after another, from the last two and the
action between them and the next, and is trained through its own predictions.

    python simvp.py --data data/push_cube --tasks tasks --out predictions --minutes 20
"""

from __future__ import annotations

import argparse
import io
import json
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

GIVEN = 2
"""Frames that the next one is predicted from; at the beginning the first one, twice."""


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


def layer(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    """A convolution of SimVP's encoder and decoder."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(2, outputs), nn.SiLU()
    )


class Inception(nn.Module):
    """An Inception block: convolutions of several sizes, added, and scaled by the action."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, hidden, 1)
        self.branches = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(hidden, channels, size, padding=size // 2, groups=8),
                nn.GroupNorm(8, channels),
                nn.SiLU(),
            )
            for size in (3, 5, 7, 11)
        )
        self.modulate = nn.Linear(hidden, 2 * channels)

    def forward(self, grid: Tensor, action: Tensor) -> Tensor:
        """The next grid `[B, C, h, w]`, by an embedded action."""
        scale, shift = self.modulate(action)[..., None, None].chunk(2, 1)
        reduced = self.reduce(grid * (1 + scale) + shift)
        return grid + sum(branch(reduced) for branch in self.branches)


class NextFrame(nn.Module):
    """Encoder, translator and decoder; frames are `[B, 3, H, W]` in [0, 1]."""

    def __init__(
        self, actions: int, channels: int = 32, hidden: int = 128, blocks: int = 4
    ) -> None:
        super().__init__()
        self.first = layer(3 * GIVEN, channels)
        self.down = nn.Sequential(layer(channels, channels, 2), layer(channels, hidden, 2))
        self.action = nn.Sequential(
            nn.Linear(actions, hidden), nn.SiLU(), nn.Linear(hidden, hidden)
        )
        self.blocks = nn.ModuleList(Inception(hidden, hidden) for _ in range(blocks))
        self.up = nn.Sequential(
            nn.Upsample(scale_factor=2), layer(hidden, channels),
            nn.Upsample(scale_factor=2), layer(channels, channels),
        )  # fmt: skip
        self.head = nn.Conv2d(2 * channels, 3, 3, padding=1)

    def forward(self, frames: list[Tensor], action: Tensor) -> Tensor:
        """The frame after these, by an action `[B, A]`."""
        skip = self.first(torch.cat(frames[-GIVEN:], 1))
        grid, embedded = self.down(skip), self.action(action)
        for block in self.blocks:
            grid = block(grid, embedded)
        return frames[-1] + self.head(torch.cat([self.up(grid), skip], 1))


class Entry:
    """The network with the scale of the actions."""

    def __init__(self, episodes: list[tuple[np.ndarray, np.ndarray]], seed: int) -> None:
        torch.manual_seed(seed)
        rows = np.concatenate([actions for _, actions in episodes])
        self.mean, self.scale = rows.mean(0), rows.std(0) + 1e-6
        self.network = NextFrame(rows.shape[1])
        self.episodes, self.random = episodes, np.random.default_rng(seed)

    def normalised(self, actions: np.ndarray) -> Tensor:
        """Actions `[T, A]` in their standard deviations."""
        return torch.from_numpy(((actions - self.mean) / self.scale).astype(np.float32))

    def rolled(self, given: Tensor, actions: Tensor) -> Tensor:
        """Frames `[B, T, 3, H, W]` after a given one `[B, 3, H, W]`, by actions `[B, T, A]`."""
        frames = [given] * GIVEN
        for action in actions.unbind(1):
            frames.append(self.network(frames, action).clamp(-0.2, 1.2))
        return torch.stack(frames[GIVEN:], 1)

    def batch(self, size: int, unrolled: int) -> tuple[Tensor, Tensor]:
        """Clips `[B, 1 + T, 3, H, W]` and their actions `[B, T, A]`, from anywhere in episodes."""
        clips, moves = [], []
        for _ in range(size):
            video, actions = self.episodes[self.random.integers(len(self.episodes))]
            start = self.random.integers(max(1, len(video) - unrolled))
            rows = np.minimum(np.arange(start, start + unrolled + 1), len(video) - 1)
            clips.append(video[rows])
            moves.append(self.normalised(actions[rows[:-1]]))
        pixels = torch.from_numpy(np.stack(clips)).permute(0, 1, 4, 2, 3) / 255
        return pixels, torch.stack(moves)

    def train(self, minutes: float, steps: int | None, rate: float = 1e-3) -> int:
        """Steps until so many CPU-minutes are over; windows get longer, from 2 to 10 frames."""
        optimizer = torch.optim.AdamW(self.network.parameters(), rate)
        begun, step, share = time.process_time(), 0, 0.0
        while share < 1:
            spent = (time.process_time() - begun) / 60 / max(minutes, 1e-9)
            share = step / steps if steps is not None else spent
            for group in optimizer.param_groups:
                group["lr"] = rate * min(1, (step + 1) / 50, 1.02 - min(share, 1))
            pixels, actions = self.batch(8, 2 + int(8 * min(share, 1)))
            error = functional.mse_loss(self.rolled(pixels[:, 0], actions), pixels[:, 1:])
            optimizer.zero_grad()
            error.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            optimizer.step()
            step += 1
            if step % 100 == 0:
                print(f"step {step}, {share:.0%}: squared error {error:.5f}", flush=True)
        return step

    @torch.no_grad()
    def predict(self, given: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """All frames of a clip `[T, H, W, 3]`, the given ones first."""
        first = torch.from_numpy(given[-1:]).permute(0, 3, 1, 2) / 255
        rows = self.normalised(actions[len(given) - 1 : -1])[None]
        pixels = self.rolled(first, rows)[0].clamp(0, 1).permute(0, 2, 3, 1)
        return np.concatenate([given, (255 * pixels).round().byte().numpy()])


def main() -> None:
    """Train, and predict every task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="dataset with the training split")
    parser.add_argument("--tasks", type=Path, required=True, help="folder of the tasks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the predictions")
    parser.add_argument("--minutes", type=float, default=20, help="CPU-minutes of training")
    parser.add_argument("--steps", type=int, help="steps of training, instead of minutes")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    entry = Entry(list(training_episodes(options.data)), options.seed)
    steps = entry.train(options.minutes, options.steps)
    entry.network.eval()
    for line in (options.tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        given = np.stack([iio.imread(options.tasks / name) for name in task["images"]])
        actions = np.load(options.tasks / task["actions"])["actions"]
        folder = options.out / task["id"]
        folder.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(entry.predict(given, actions)):
            iio.imwrite(folder / f"{number:04d}.png", frame)
    count = sum(weight.numel() for weight in entry.network.parameters())
    facts = f"name: SimVP-like, {steps} steps\nparameters: {count}\ndata: the training split\n"
    (options.out / "entry.yaml").write_text(facts)


if __name__ == "__main__":
    main()
