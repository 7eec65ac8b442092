"""Train the weights that ship with `Compact`; docs/codecs.md says with which data and seed.

    python -m acwm_codecs.train_compact data/push_cube data/push_cube_240 --out compact.safetensors

Every step sees random groups of four consecutive frames, cropped to 64×64, mirrored and with
permuted colour channels, so that the codec serves other scenes than the ones it saw. Noise on the
latents during training makes the decoder forgiving of the errors a dynamics model makes.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor, nn

from acwm_codecs.compact import STRIDE, Compact, training_record
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset

CROP = 64
LATENT_NOISE = 0.1
STILL_FRACTION = 0.15  # groups that repeat one frame, as the first latent frame does

Videos = list[NDArray[np.uint8]]
"""Videos `[T, H, W, 3]`, 0-255."""


def load_videos(folder: Path, most: int) -> Videos:
    """Up to `most` training videos `[T, H, W, 3]` of a dataset, decoded into memory."""
    episodes = EpisodeDataset(folder, "train")
    return [episodes[index].video for index in range(min(most, len(episodes)))]


def sample_groups(videos: Videos, count: int, rng: np.random.Generator) -> Tensor:
    """Random augmented groups as folded frames, `[count, 12, 64, 64]` in [0, 1]."""
    groups: list[NDArray[np.uint8]] = []
    for _ in range(count):
        video = videos[int(rng.integers(len(videos)))]
        time_steps, height, width, _ = video.shape
        start = int(rng.integers(time_steps - STRIDE))
        frames = [start] * STRIDE if rng.random() < STILL_FRACTION else range(start, start + STRIDE)
        y, x = int(rng.integers(height - CROP + 1)), int(rng.integers(width - CROP + 1))
        group = video[list(frames), y : y + CROP, x : x + CROP][..., rng.permutation(3)]
        group = group[:, :: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        groups.append(np.ascontiguousarray(group.transpose(0, 3, 1, 2).reshape(-1, CROP, CROP)))
    batch = torch.from_numpy(np.stack(groups)).float() / 255
    return batch.contiguous(memory_format=torch.channels_last)


def training_loss(codec: Compact, groups: Tensor, generator: torch.Generator) -> Tensor:
    """Mean squared error of the reconstruction through noisy latents."""
    latents = codec.normalise(codec.encoder(groups * 2 - 1))
    noise = torch.randn(latents.shape, generator=generator)
    reconstruction = codec.decoder(latents + LATENT_NOISE * noise).float() / 2 + 0.5
    return nn.functional.mse_loss(reconstruction, groups)


def learning_rate(fraction: float, peak: float) -> float:
    """Linear warm-up over the first 2 %, cosine decay to 1 % of the peak at the end."""
    warm = min(1.0, fraction / 0.02)
    return peak * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(fraction, 1.0))))


def provenance(folder: Path, episodes: int) -> dict[str, Any]:
    """What `acwm generate` needs to make the part of a dataset that was trained on again."""
    card = DatasetCard.read(folder)
    return {
        "environment": card.environment.name,
        "frame_size": list(card.environment.frame_size),
        "seed": card.seed,
        "episodes": min(episodes, card.splits["train"]),
    }


def train(
    codec: Compact, sources: Sequence[Videos], steps: int, batch: int, peak: float, seed: int
) -> Iterator[tuple[int, float]]:
    """Train in place; yields the number of steps done and a running mean of the loss."""
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(codec.parameters(), betas=(0.9, 0.99), weight_decay=1e-4)
    running = 0.0
    for step in range(1, steps + 1):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step / steps, peak)
        groups = torch.cat([sample_groups(s, batch // len(sources), rng) for s in sources])
        with torch.autocast("cpu", dtype=torch.bfloat16):
            loss = training_loss(codec, groups, generator)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
        optimizer.step()
        running = loss.item() if step == 1 else 0.98 * running + 0.02 * loss.item()
        yield step, running


@click.command()
@click.argument("data", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True)
@click.option("--steps", default=3600, show_default=True)
@click.option("--batch", default=32, show_default=True, help="Groups per step.")
@click.option("--peak", default=1e-3, show_default=True, help="Peak learning rate.")
@click.option("--episodes", default=300, show_default=True, help="Episodes read per dataset.")
@click.option("--start", default="random", show_default=True, help="Weights to start from.")
@click.option("--seed", default=0, show_default=True)
@click.option("--threads", default=0, help="CPU threads; 0 leaves PyTorch's choice.")
def main(
    data: tuple[Path, ...],
    out: Path,
    steps: int,
    batch: int,
    peak: float,
    episodes: int,
    start: str,
    seed: int,
    threads: int,
) -> None:
    """Train on the training split of the datasets DATA… and write --out."""
    if threads:
        torch.set_num_threads(threads)
    torch.manual_seed(seed)
    codec = Compact(weights=start).train()
    record = {
        "data": [provenance(folder, episodes) for folder in data],
        "batch": batch,
        "peak_learning_rate": peak,
        "seed": seed,
        "start": start if start == "random" else training_record(Path(start)),
    }
    sources = [load_videos(folder, episodes) for folder in data]
    began = time.monotonic()
    for step, loss in train(codec, sources, steps, batch, peak, seed):
        if step % 250 == 0 or step == steps:
            save(codec, out, {**record, "steps": step, "of_steps": steps})
            seconds = time.monotonic() - began
            click.echo(f"step {step}: {-10 * math.log10(loss):.2f} dB, {seconds:.0f} s")


def save(codec: Compact, out: Path, record: dict[str, Any]) -> None:
    """Write the weights as float16 with a record of how they were made."""
    state = {
        name: value.half().contiguous() if value.is_floating_point() else value
        for name, value in codec.state_dict().items()
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file(state, out, metadata={"training": json.dumps(record)})


if __name__ == "__main__":
    main()
