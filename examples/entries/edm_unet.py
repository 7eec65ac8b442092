"""A diffusion model of the next frame: EDM and a U-Net, as in DIAMOND.

An entry for the ACWM-Phys benchmark in plain PyTorch; it imports nothing of acwm. DIAMOND (Alonso
et al. 2024, arXiv 2405.12399) denoises the next frame, given the last four and their actions, by
the preconditioning of EDM (Karras et al. 2022, arXiv 2206.00364), in three deterministic steps.
Settings are DIAMOND's for Atari; `--channels 64` is its width, and less trains faster.

    python edm_unet.py --data data/push_cube --tasks tasks --out predictions --minutes 20
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import math
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

PAST = 4
"""Frames and actions that the next frame is predicted from."""

SIGMA_DATA, OFFSET_NOISE = 0.5, 0.3
LOG_SIGMA_MEAN, LOG_SIGMA_STD, SIGMA_LEAST, SIGMA_MOST = -0.4, 1.2, 2e-3, 20.0
"""The noise that is learnt: normal in its logarithm, and cut off."""

STEPS, FIRST_SIGMA, LAST_SIGMA, RHO = 3, 5.0, 2e-3, 7
"""Sampling: Euler steps on the schedule of EDM."""


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


class AdaptiveNorm(nn.Module):
    """Group normalisation, scaled and shifted by the condition."""

    def __init__(self, channels: int, condition: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(max(1, channels // 32), channels, affine=False)
        self.linear = nn.Linear(condition, 2 * channels)

    def forward(self, grid: Tensor, condition: Tensor) -> Tensor:
        """The grid `[B, C, H, W]` by a condition `[B, …]`."""
        scale, shift = self.linear(condition)[..., None, None].chunk(2, 1)
        return self.norm(grid) * (1 + scale) + shift


class Residual(nn.Module):
    """Two convolutions whose norms are adaptive."""

    def __init__(self, inputs: int, outputs: int, condition: int) -> None:
        super().__init__()
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()
        self.norms = nn.ModuleList(AdaptiveNorm(size, condition) for size in (inputs, outputs))
        self.convolutions = nn.ModuleList(
            nn.Conv2d(size, outputs, 3, padding=1) for size in (inputs, outputs)
        )
        nn.init.zeros_(self.convolutions[1].weight)

    def forward(self, grid: Tensor, condition: Tensor) -> Tensor:
        """The next grid."""
        result = grid
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            result = convolution(functional.silu(norm(result, condition)))
        return self.skip(grid) + result


class UNet(nn.Module):
    """Four levels of two residual blocks, with skips from each block on the way down.

    Args:
        actions: size of an action.
        channels: of every level.
        condition: size of the vector of noise level and actions.
    """

    def __init__(
        self, actions: int, channels: int = 64, condition: int = 256, levels: int = 4
    ) -> None:
        super().__init__()
        self.register_buffer("frequencies", torch.randn(condition // 2))
        self.actions = nn.Linear(PAST * actions, condition)
        self.condition = nn.Sequential(
            nn.Linear(condition, condition), nn.SiLU(), nn.Linear(condition, condition)
        )
        self.first = nn.Conv2d(3 * (PAST + 1), channels, 3, padding=1)
        self.down = nn.ModuleList(
            Residual(channels, channels, condition) for _ in range(2 * levels)
        )
        self.middle = Residual(channels, channels, condition)
        self.up = nn.ModuleList(
            Residual(2 * channels, channels, condition) for _ in range(2 * levels)
        )
        self.last = AdaptiveNorm(channels, condition)
        self.head = nn.Conv2d(channels, 3, 3, padding=1)
        nn.init.zeros_(self.head.weight)

    def forward(self, noisy: Tensor, level: Tensor, past: Tensor, actions: Tensor) -> Tensor:
        """`noisy` `[B, 3, H, W]`, `level` `[B]`, `past` `[B, 3 · PAST, H, W]`, actions `[B, …]`."""
        waves = 2 * math.pi * level[:, None] * self.frequencies
        embedded = torch.cat([waves.cos(), waves.sin()], 1) + self.actions(actions)
        condition = self.condition(embedded)
        grid, skips = self.first(torch.cat([noisy, past], 1)), []
        for number, block in enumerate(self.down):
            if number and number % 2 == 0:
                grid = functional.avg_pool2d(grid, 2)
            grid = block(grid, condition)
            skips.append(grid)
        grid = self.middle(grid, condition)
        for block in self.up:
            skip = skips.pop()
            if skip.shape[-1] != grid.shape[-1]:
                grid = functional.interpolate(grid, size=skip.shape[-2:])
            grid = block(torch.cat([grid, skip], 1), condition)
        return self.head(functional.silu(self.last(grid, condition)))


class Entry:
    """The network, its preconditioning, and the scale of the actions."""

    def __init__(
        self, episodes: list[tuple[np.ndarray, np.ndarray]], channels: int, seed: int
    ) -> None:
        torch.manual_seed(seed)
        rows = np.concatenate([actions for _, actions in episodes])
        self.mean, self.scale = rows.mean(0), rows.std(0) + 1e-6
        self.network = UNet(rows.shape[1], channels)
        self.episodes, self.random = episodes, np.random.default_rng(seed)

    def normalised(self, actions: np.ndarray) -> Tensor:
        """Actions `[T, A]` in their standard deviations."""
        return torch.from_numpy(((actions - self.mean) / self.scale).astype(np.float32))

    def denoised(self, noisy: Tensor, sigma: Tensor, past: Tensor, actions: Tensor) -> Tensor:
        """The frame that a noisy one `[B, 3, H, W]` of noise `[B]` shows (EDM, eq. 7)."""
        spread = (sigma**2 + OFFSET_NOISE**2).sqrt()  # offset noise counts, as in DIAMOND
        total = (spread**2 + SIGMA_DATA**2).sqrt()[:, None, None, None]
        kept = SIGMA_DATA**2 / total**2
        changed = spread[:, None, None, None] * SIGMA_DATA / total
        output = self.network(noisy / total, spread.log() / 4, past / SIGMA_DATA, actions)
        return kept * noisy + changed * output

    def loss(self, size: int) -> Tensor:
        """The weighted error of some denoised frames (EDM, eq. 8)."""
        clips, moves = [], []
        for _ in range(size):
            video, actions = self.episodes[self.random.integers(len(self.episodes))]
            last = self.random.integers(len(video) - 1)
            rows = np.maximum(np.arange(last - PAST + 1, last + 2), 0)
            clips.append(video[rows])
            moves.append(self.normalised(actions[rows[:-1]]).flatten())
        pixels = torch.from_numpy(np.stack(clips)).permute(0, 1, 4, 2, 3) / 127.5 - 1
        past, true = pixels[:, :-1].flatten(1, 2), pixels[:, -1]
        sigma = (LOG_SIGMA_MEAN + LOG_SIGMA_STD * torch.randn(size)).exp()
        sigma = sigma.clamp(SIGMA_LEAST, SIGMA_MOST)
        noise = sigma[:, None, None, None] * torch.randn_like(true)
        noisy = true + noise + OFFSET_NOISE * torch.randn(size, 3, 1, 1)
        denoised = self.denoised(noisy, sigma, past, torch.stack(moves))
        spread2 = sigma**2 + OFFSET_NOISE**2
        weight = (spread2 + SIGMA_DATA**2) / (spread2 * SIGMA_DATA**2)
        return (weight * (denoised - true).square().mean((1, 2, 3))).mean()

    def train(self, minutes: float, steps: int | None, rate: float = 1e-4) -> int:
        """Steps until so many CPU-minutes are over."""
        optimizer = torch.optim.AdamW(self.network.parameters(), rate, weight_decay=1e-2)
        begun, step, share = time.process_time(), 0, 0.0
        while share < 1:
            loss = self.loss(32)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            for group in optimizer.param_groups:
                group["lr"] = rate * min(1, (step + 1) / 100)
            optimizer.step()
            step += 1
            spent = (time.process_time() - begun) / 60 / max(minutes, 1e-9)
            share = step / steps if steps is not None else spent
            if step % 50 == 0:
                print(f"step {step}, {share:.0%}: weighted error {loss:.4f}", flush=True)
        return step

    @torch.no_grad()
    def predict(self, given: np.ndarray, actions: np.ndarray, seed: int) -> np.ndarray:
        """All frames of a clip; before the first frame the scene is as in it, and at rest."""
        random, moves = torch.Generator().manual_seed(seed), self.normalised(actions)
        frames = [*torch.from_numpy(given).permute(0, 3, 1, 2) / 127.5 - 1]
        for frame in range(len(given), len(actions)):
            rows = [max(0, frame - number) for number in range(PAST, 0, -1)]
            past = torch.cat([frames[row] for row in rows])[None]
            frames.append(self._sampled(past, moves[rows].flatten()[None], random)[0])
        pixels = torch.stack(frames).permute(0, 2, 3, 1)
        whole = ((pixels + 1) * 127.5).round().clamp(0, 255).byte().numpy()
        return np.concatenate([given, whole[len(given) :]])

    def _sampled(self, past: Tensor, actions: Tensor, random: torch.Generator) -> Tensor:
        roots = torch.linspace(FIRST_SIGMA ** (1 / RHO), LAST_SIGMA ** (1 / RHO), STEPS)
        sigmas = [*(roots**RHO), torch.zeros(())]
        shape = (1, 3, *past.shape[-2:])
        frame = FIRST_SIGMA * torch.randn(shape, generator=random)
        for sigma, following in itertools.pairwise(sigmas):
            clean = self.denoised(frame, sigma[None], past, actions)
            frame = frame + (following - sigma) * (frame - clean) / sigma
        return frame.clamp(-1, 1)


def main() -> None:
    """Train, and predict every task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="dataset with the training split")
    parser.add_argument("--tasks", type=Path, required=True, help="folder of the tasks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the predictions")
    parser.add_argument("--channels", type=int, default=64)
    parser.add_argument("--minutes", type=float, default=20, help="CPU-minutes of training")
    parser.add_argument("--steps", type=int, help="steps of training, instead of minutes")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    entry = Entry(list(training_episodes(options.data)), options.channels, options.seed)
    steps = entry.train(options.minutes, options.steps)
    entry.network.eval()
    for line in (options.tasks / "index.jsonl").read_text().splitlines():
        task = json.loads(line)
        given = np.stack([iio.imread(options.tasks / name) for name in task["images"]])
        actions = np.load(options.tasks / task["actions"])["actions"]
        folder = options.out / task["id"]
        folder.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(entry.predict(given, actions, task["seed"])):
            iio.imwrite(folder / f"{number:04d}.png", frame)
    count = sum(weight.numel() for weight in entry.network.parameters())
    facts = f"name: EDM U-Net, {steps} steps\nparameters: {count}\ndata: the training split\n"
    (options.out / "entry.yaml").write_text(facts)


if __name__ == "__main__":
    main()
