"""Trains `Compact` (`acwm train-codec`); `make codec-weights` made the weights that ship.

Every step uses random groups of four consecutive frames, cropped to 64×64, from all datasets with
equal probability. Some are mirrored and have permuted colour channels, so that the codec also works
on unseen scenes. Noise on the latents during training makes the decoder robust to the errors of a
dynamics model.
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

from acwm_codecs.compact import PACKAGED_WEIGHTS, STRIDE, Compact
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.files import training_record, written_whole
from acwm_core.model.shapes import check_finite

CROP = 64
LATENT_NOISE = 0.05
SPREAD_WEIGHT = 2e-4
MEASURED_BATCHES = 64  # batches for the statistics of the latents
STILL_FRACTION = 0.15  # groups that repeat one frame, as the first latent frame does
STRANGE_FRACTION = 0.25  # groups that are mirrored and have permuted colours
WARM_UP = 50  # steps
TEST_EPISODES = 8  # episodes on which reconstructions are compared
MEMORY = 0.95  # weight of the old value in the running error of a dataset

Videos = list[NDArray[np.uint8]]
"""Videos `[T, H, W, 3]`, 0-255."""


def load_videos(folder: Path, most: int) -> Videos:
    """Up to `most` training videos `[T, H, W, 3]` of a dataset, decoded into memory.

    Raises:
        DataError: there are none, or a frame is too small for a crop, or an episode too short.
    """
    episodes = EpisodeDataset(folder, "train")
    height, width = episodes.card.environment.frame_size
    if min(height, width) < CROP:
        raise DataError(
            f"frames of {folder} are {height}×{width}, and training needs {CROP}×{CROP}"
        )
    if min(episodes.lengths[:most]) < STRIDE:
        raise DataError(f"{folder} has an episode of less than the {STRIDE} frames of a latent one")
    videos = (episodes.video(index) for index in range(min(most, len(episodes))))
    return [np.ascontiguousarray(video.transpose(0, 2, 3, 1)) for video in videos]


def random_group(videos: Videos, rng: np.random.Generator) -> NDArray[np.uint8]:
    """One augmented group of four frames, folded to `[12, 64, 64]`."""
    video = videos[int(rng.integers(len(videos)))]
    time_steps, height, width, _ = video.shape
    start = int(rng.integers(time_steps - STRIDE + 1))
    frames = [start] * STRIDE if rng.random() < STILL_FRACTION else range(start, start + STRIDE)
    y, x = int(rng.integers(height - CROP + 1)), int(rng.integers(width - CROP + 1))
    group = video[list(frames), y : y + CROP, x : x + CROP]
    if rng.random() < STRANGE_FRACTION:
        group = group[:, :: rng.choice([-1, 1]), :: rng.choice([-1, 1]), rng.permutation(3)]
    return np.ascontiguousarray(group.transpose(0, 3, 1, 2).reshape(-1, CROP, CROP))


def sample_groups(
    sources: Sequence[Videos], count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Groups `[count, 12, 64, 64]` in [0, 1] from random sources, and their sources `[count]`."""
    chosen = rng.integers(len(sources), size=count)
    groups = np.stack([random_group(sources[source], rng) for source in chosen])
    batch = torch.from_numpy(groups).float() / 255
    return batch.contiguous(memory_format=torch.channels_last), torch.from_numpy(chosen)


@torch.no_grad()
def measure_latents(codec: Compact, sources: Sequence[Videos], batch: int, seed: int) -> None:
    """Measure the mean and variance for `normalise` on random groups, and fix them.

    With statistics of the current batch, the decoder would only learn the brightness of a frame
    relative to the other frames of its batch.
    """
    rng = np.random.default_rng([seed, 1])
    codec.normalise.reset_running_stats()
    codec.normalise.train().momentum = None  # an average over all batches
    for _ in range(MEASURED_BATCHES):
        groups, _ = sample_groups(sources, batch, rng)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            codec.normalise(codec.encoder(groups * 2 - 1))
    codec.normalise.eval()


def losses(codec: Compact, groups: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """The losses of a reconstruction from noisy latents.

    Returns:
        The mean squared error `[N]` of each group, and how far the latents' mean and variance are
        from 0 and 1. Without the second part, latents would grow until the noise is negligible.
    """
    with torch.autocast("cpu", dtype=torch.bfloat16):
        latents = codec.normalise(codec.encoder(groups * 2 - 1))
        noise = torch.randn(latents.shape, generator=generator)
        reconstruction = codec.decoder(latents + LATENT_NOISE * noise).float() / 2 + 0.5
    variance, mean = torch.var_mean(latents.float(), (0, 2, 3))
    spread = (mean.square() + (variance - 1).square()).mean()
    return (reconstruction - groups).square().mean((1, 2, 3)), spread


def learning_rate(step: int, steps: int, peak: float, decay: float) -> float:
    """Linear warm-up, then the peak, then linear to zero over the last share `decay` of steps."""
    left = (steps - step) / (decay * steps) if decay else 1.0
    return peak * min(1.0, step / WARM_UP, left)


def provenance(folder: Path, episodes: int) -> dict[str, Any]:
    """The settings with which `acwm generate` can make the training part of a dataset again."""
    card = DatasetCard.read(folder)
    return {
        "environment": card.environment.name,
        "frame_size": list(card.environment.frame_size),
        "seed": card.seed,
        "episodes": min(episodes, card.splits["train"]),
    }


class RunningErrors:
    """The running mean squared error of each source, which determines its weight in the loss.

    Weights are inverse to the square root of a source's error. This is halfway between the mean
    error, which the hardest source would dominate, and the mean PSNR, which treats all sources
    equally.
    """

    def __init__(self, sources: int) -> None:
        self.values = torch.full((sources,), math.nan)

    def update(self, errors: Tensor, chosen: Tensor) -> Tensor:
        """Add the errors `[N]` of groups from the sources `chosen` `[N]`; returns weights `[N]`."""
        for source, error in zip(chosen.tolist(), errors.tolist(), strict=True):
            old = self.values[source].item()
            mixed = error if math.isnan(old) else MEMORY * old + (1 - MEMORY) * error
            self.values[source] = mixed
        weights = self.values[chosen].clamp(min=1e-6).rsqrt()
        return weights / weights.sum()

    def decibels(self) -> list[float]:
        """PSNR of each source; NaN if it was never drawn."""
        return (-10 * self.values.log10()).tolist()


def train(
    codec: Compact,
    sources: Sequence[Videos],
    steps: int,
    batch: int,
    peak: float,
    decay: float,
    seed: int,
    decoder_only: bool = False,
) -> Iterator[tuple[int, RunningErrors]]:
    """Train in place; yields the number of steps done and the running errors.

    With `decoder_only`, the encoder and the statistics of its latents stay as they are.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    running = RunningErrors(len(sources))
    if decoder_only:
        codec.encoder.requires_grad_(False)
        codec.normalise.eval()
    else:
        measure_latents(codec, sources, batch, seed)
    trained = [parameter for parameter in codec.parameters() if parameter.requires_grad]
    optimizer = torch.optim.AdamW(trained, betas=(0.9, 0.99), weight_decay=1e-4)
    for step in range(1, steps + 1):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, steps, peak, decay)
        groups, chosen = sample_groups(sources, batch, rng)
        errors, spread = losses(codec, groups, generator)
        weights = running.update(errors.detach(), chosen)
        loss = (errors * weights).sum() + SPREAD_WEIGHT * spread
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(codec.parameters(), 1.0)
        optimizer.step()
        yield step, running


def train_on(
    data: Sequence[Path],
    out: Path,
    *,
    start: str,
    decoder_only: bool,
    steps: int,
    batch: int,
    peak: float,
    decay: float,
    episodes: int,
    seed: int,
    threads: int,
) -> None:
    """Train on the training splits of datasets and write the weights; see `acwm train-codec`.

    Raises:
        DataError: the data, the initial weights or the name of the file are unsuitable.
    """
    if out.suffix != ".safetensors":
        raise DataError(f"--out {out} must end in .safetensors, as that is what it will be")
    if decoder_only and start == "random":
        raise DataError("--decoder-only keeps an encoder, so it cannot --start random")
    sources = [load_videos(folder, episodes) for folder in data]
    if threads:
        torch.set_num_threads(threads)
    torch.manual_seed(seed)
    codec = Compact(weights=None if start == "compact" else start).train()
    record = {
        "data": [provenance(folder, episodes) for folder in data],
        "batch": batch,
        "peak_learning_rate": peak,
        "decay": decay,
        "seed": seed,
        "start": start if start == "random" else training_record(_file(start)),
        **({"decoder_only": True} if decoder_only else {}),
    }
    before = [reconstruction(codec, folder) for folder in data]
    began = time.monotonic()
    for step, running in train(codec, sources, steps, batch, peak, decay, seed, decoder_only):
        if step % 100 == 0 or step == steps:
            save(codec, out, {**record, "steps": step, "of_steps": steps})
            seconds = time.monotonic() - began
            psnr = " ".join(
                f"{folder.name} {value:.1f}"
                for folder, value in zip(data, running.decibels(), strict=True)
            )
            click.echo(f"step {step}, {seconds:.0f} s, dB: {psnr}")
    for folder, old in zip(data, before, strict=True):
        if old is not None:
            now = reconstruction(Compact(weights=str(out)), folder)
            click.echo(f"{folder}: {old:.2f} dB before and {now:.2f} dB now, on test episodes")
    click.echo(f"{out}; use it by codec.weights={out}")


def _file(start: str) -> Path:
    return PACKAGED_WEIGHTS if start == "compact" else Path(start)


@torch.no_grad()
def reconstruction(codec: Compact, folder: Path) -> float | None:
    """PSNR in dB of the codec's reconstruction of the first test episodes; None without any."""
    if "ind_test" not in DatasetCard.read(folder).splits:
        return None
    training, errors = codec.training, list[float]()
    codec.eval()
    tests = EpisodeDataset(folder, "ind_test")
    for index in range(min(TEST_EPISODES, len(tests))):
        video = torch.as_tensor(tests.video(index)).float()[None] / 255
        errors.append((codec(video) - video).square().mean().item())
    codec.train(training)
    return -10 * math.log10(max(float(np.mean(errors)), 1e-12))


def save(codec: Compact, out: Path, record: dict[str, Any]) -> None:
    """Write the weights as float16, with a record of how they were made."""
    state = {
        name: value.half().contiguous() if value.is_floating_point() else value
        for name, value in codec.state_dict().items()
    }
    check_finite(out, state)
    out.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(out) as partial:
        save_file(state, partial, metadata={"training": json.dumps(record)})
