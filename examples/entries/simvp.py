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
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

GIVEN = 2
"""Frames that the next one is predicted from; at the beginning the first one, twice."""

SCENES, LEARNT = 8, 2
"""Scenes that are predicted side by side, and the frames of each that a step learns."""


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

    def __init__(self, actions: int, channels: int = 32, hidden: int = 64, blocks: int = 4) -> None:
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


@dataclass
class Scene:
    """A training episode on which the network moves on.

    Args:
        video: true frames `[T, 3, H, W]` in [0, 1].
        actions: its normalised actions `[T, A]`.
        frame: number of the last frame.
        last: the last two frames `[2, 3, H, W]`, true or predicted.
    """

    video: Tensor
    actions: Tensor
    frame: int
    last: Tensor


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

    def rolled(self, frames: list[Tensor], actions: Tensor) -> list[Tensor]:
        """These frames `[B, 3, H, W]` and the following ones, by actions `[B, T, A]`."""
        for action in actions.unbind(1):
            frames = [*frames, self.network(frames, action).clamp(-0.2, 1.2)]
        return frames

    def scene(self) -> Scene:
        """An episode from anywhere in it, before anything is predicted."""
        video, actions = self.episodes[self.random.integers(len(self.episodes))]
        frame = int(self.random.integers(len(video) - LEARNT))
        pixels = torch.from_numpy(video).permute(0, 3, 1, 2) / 255
        return Scene(pixels, self.normalised(actions), frame, pixels[[max(0, frame - 1), frame]])

    def train(self, minutes: float, steps: int | None, rate: float = 1e-3) -> int:
        """Steps until so many CPU-minutes are over; scenes begin anew ever less often."""
        optimizer = torch.optim.AdamW(self.network.parameters(), rate)
        begun, step, share = time.process_time(), 0, 0.0
        scenes = [self.scene() for _ in range(SCENES)]
        while share < 1:
            spent = (time.process_time() - begun) / 60 / max(minutes, 1e-9)
            share = step / steps if steps is not None else spent
            for group in optimizer.param_groups:
                group["lr"] = rate * min(1, (step + 1) / 50, 1.02 - min(share, 1))
            goes_on = self.random.random(SCENES) < 0.5 + 0.5 * share
            scenes = [
                scene if kept and scene.frame + LEARNT < len(scene.video) else self.scene()
                for scene, kept in zip(scenes, goes_on, strict=True)
            ]
            error = self.error(scenes)
            optimizer.zero_grad()
            error.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            optimizer.step()
            step += 1
            if step % 100 == 0:
                print(f"step {step}, {share:.0%}: squared error {error:.5f}", flush=True)
        return step

    def error(self, scenes: list[Scene]) -> Tensor:
        """The squared error of the next frames of scenes, which move on by what was predicted."""
        last = list(torch.stack([scene.last for scene in scenes]).unbind(1))
        moves = [scene.actions[scene.frame : scene.frame + LEARNT] for scene in scenes]
        frames = self.rolled(last, torch.stack(moves))
        true = [scene.video[scene.frame + 1 : scene.frame + 1 + LEARNT] for scene in scenes]
        for number, scene in enumerate(scenes):
            scene.last = torch.stack([frame[number] for frame in frames[-GIVEN:]]).detach()
            scene.frame += LEARNT
        return functional.mse_loss(torch.stack(frames[GIVEN:], 1), torch.stack(true))

    @torch.no_grad()
    def predict(self, given: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """All frames of a clip `[T, H, W, 3]`, the given ones first."""
        first = torch.from_numpy(given[-1:]).permute(0, 3, 1, 2) / 255
        rows = self.normalised(actions[len(given) - 1 : -1])[None]
        frames = torch.cat(self.rolled([first] * GIVEN, rows)[GIVEN:])
        pixels = frames.clamp(0, 1).permute(0, 2, 3, 1)
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
