"""Trains `Compact`, `Fine` and `CompactReference` (`acwm train-codec`).

Every step uses random groups of four consecutive frames, cropped to 64×64, from all datasets with
equal probability. Some are mirrored and have permuted colour channels, so that the codec also works
on unseen scenes. Latents are made noisy and some of their cells are emptied, so that the decoder
bears the errors of a dynamics model. What moves, edges and the worst place of a group count for
more than the rest: small objects are a few pixels.

A decoder can also learn from latents as a model predicts them (`--predicted-by`), which are wrong
in other ways than noisy ones.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from acwm_codecs.compact import STRIDE, Compact, Fine
from acwm_codecs.compact_reference import CompactReference
from acwm_codecs.frame_groups import Groups, Source, load_videos, sample_groups
from acwm_codecs.predicted import EpisodePredictor
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.files import load_plain, training_record, written_whole
from acwm_core.model.precision import bfloat16_is_fast
from acwm_core.model.shapes import check_finite

CODECS: dict[str, type[Compact]] = {
    codec.name: codec for codec in (Compact, Fine, CompactReference)
}
"""The codecs that can be trained."""

LATENT_NOISE = 0.05
EMPTY_FRACTION = 0.01  # cells of latents that are set to zero
WITHOUT_REFERENCE = 0.1  # steps in which a decoder that can see a reference sees none
DETAIL_WEIGHT = 0.5
WORST_WEIGHT = 0.02
WORST_CELL = 8  # side of a cell, in pixels
SPREAD_WEIGHT = 2e-4
MEASURED_BATCHES = 64  # batches for the statistics of the latents
WARM_UP = 200  # steps
TEST_PIXELS = 2_000_000  # of test episodes on which reconstructions are compared, but one whole
MEMORY = 0.95  # weight of the old value in the running error of a dataset
NORM_MEMORY = 0.99  # weight of the old value in the running norm of the gradient
CLIPPED_AT = 2.0  # gradients above this many running norms are clipped


@torch.no_grad()
def measure_latents(codec: Compact, sources: Sequence[Source], batch: int, seed: int) -> None:
    """Measure the mean and variance for `normalise` on random groups, and fix them.

    With statistics of the current batch, the decoder would only learn the brightness of a frame
    relative to the other frames of its batch.
    """
    rng = np.random.default_rng([seed, 1])
    codec.normalise.reset_running_stats()
    codec.normalise.train().momentum = None  # an average over all batches
    for _ in range(MEASURED_BATCHES):
        groups = sample_groups(sources, batch, rng)
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16_is_fast()):
            codec.normalise(codec.encoder(groups.frames * 2 - 1))
    codec.normalise.eval()


def losses(
    codec: Compact, groups: Groups, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """The losses of a reconstruction from noisy latents, or from those that a model predicts.

    Returns:
        The loss `[N]` and the mean squared error `[N]` of each group, and how far the latents' mean
        and variance are from 0 and 1. Without the last, latents would grow until the noise is
        negligible.
    """
    frames, reference = groups.frames, groups.references
    if torch.rand((), generator=generator) < WITHOUT_REFERENCE:
        reference = None
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16_is_fast()):
        latents = codec.normalise(codec.encoder(frames[~groups.predicted] * 2 - 1))
        noise = torch.randn(latents.shape, generator=generator)
        kept = torch.rand(latents[:, :1].shape, generator=generator) >= EMPTY_FRACTION
        seen = (latents + LATENT_NOISE * noise) * kept
        if len(groups.latents):
            own, seen = seen, seen.new_empty(len(frames), *seen.shape[1:])
            seen[~groups.predicted], seen[groups.predicted] = own, groups.latents.to(own)
        decoded = codec.decode_groups(seen, reference)
    squared = (decoded - frames).square()
    worst = functional.avg_pool2d(squared, WORST_CELL).mean(1).amax((1, 2))
    weighted = (squared * detail_weights(frames)).mean((1, 2, 3))
    spread = squared.new_zeros(())
    if len(latents):
        variance, mean = torch.var_mean(latents.float(), (0, 2, 3))
        spread = (mean.square() + (variance - 1).square()).mean()
    return weighted + WORST_WEIGHT * worst, squared.mean((1, 2, 3)), spread


def detail_weights(groups: Tensor) -> Tensor:
    """Weights of the pixels of groups `[N, 12, H, W]`, of mean 1, larger at motion and edges."""
    frames = groups.unflatten(1, (STRIDE, -1))
    detail = (frames - frames.mean(1, keepdim=True)).abs()
    detail[..., 1:, :] += (frames[..., 1:, :] - frames[..., :-1, :]).abs()
    detail[..., :, 1:] += (frames[..., :, 1:] - frames[..., :, :-1]).abs()
    detail = detail.mean(2, keepdim=True).expand_as(frames).flatten(1, 2)
    relative = detail / detail.mean((1, 2, 3), keepdim=True).clamp(min=1e-4)
    weights = 1 + DETAIL_WEIGHT * relative
    return weights / weights.mean((1, 2, 3), keepdim=True)


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


class Training:
    """A training of a codec, which can be stored and continued.

    Args:
        codec: the codec, trained in place.
        sources: the datasets.
        decoder_only: keep the encoder and the statistics of its latents as they are.
        batch: groups per step.
        seed: seed of the groups and of the noise.
    """

    def __init__(
        self,
        codec: Compact,
        sources: Sequence[Source],
        *,
        batch: int,
        seed: int,
        decoder_only: bool = False,
    ) -> None:
        self.codec, self.sources, self.batch = codec, sources, batch
        self.step = 0
        self.running = RunningErrors(len(sources))
        self._rng = np.random.default_rng(seed)
        self._noise = torch.Generator().manual_seed(seed)
        self._norm = 0.0
        if decoder_only:
            codec.encoder.requires_grad_(False)
            codec.normalise.eval()
        else:
            measure_latents(codec, sources, batch, seed)
        trained = [parameter for parameter in codec.parameters() if parameter.requires_grad]
        self._optimizer = torch.optim.AdamW(trained, betas=(0.9, 0.99), weight_decay=1e-4)

    def steps(self, steps: int, peak: float, decay: float) -> Iterator[int]:
        """Train up to `steps` steps; yields the number of steps done. See `learning_rate`."""
        while self.step < steps:
            self.step += 1
            for group in self._optimizer.param_groups:
                group["lr"] = learning_rate(self.step, steps, peak, decay)
            groups = sample_groups(self.sources, self.batch, self._rng)
            each, errors, spread = losses(self.codec, groups, self._noise)
            weights = self.running.update(errors.detach(), groups.sources)
            loss = (each * weights).sum() + SPREAD_WEIGHT * spread
            self._optimizer.zero_grad()
            loss.backward()
            self._clip()
            self._optimizer.step()
            yield self.step

    def told(self, names: Sequence[str]) -> str:
        """The PSNR of each source, beside its name."""
        decibels = zip(names, self.running.decibels(), strict=True)
        return " ".join(f"{name} {value:.1f}" for name, value in decibels)

    def _clip(self) -> None:
        """Clip the gradient relative to those before, as a rare one would undo a training."""
        largest = CLIPPED_AT * self._norm if self.step > WARM_UP else math.inf
        norm = float(nn.utils.clip_grad_norm_(self.codec.parameters(), largest))
        mixed = NORM_MEMORY * self._norm + (1 - NORM_MEMORY) * min(norm, largest)
        self._norm = mixed if self._norm else norm

    def store(self, path: Path, record: dict[str, Any]) -> None:
        """Write all that `restore` needs, with the record of the training."""
        state = {
            "record": json.dumps(record),
            "step": self.step,
            "codec": self.codec.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "running": self.running.values,
            "norm": self._norm,
            "rng": json.dumps(self._rng.bit_generator.state),
            "noise": self._noise.get_state(),
        }
        with written_whole(path) as partial:
            torch.save(state, partial)

    def restore(self, path: Path, record: dict[str, Any]) -> None:
        """Go on where `store` was called.

        Raises:
            DataError: it is the state of another training.
        """
        state: Any = load_plain(path)
        if state["record"] != json.dumps(record):
            raise DataError(
                f"{path} belongs to an interrupted training with other settings: repeat "
                "its command to continue, or remove the file"
            )
        self.step = state["step"]
        self.codec.load_state_dict(state["codec"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.running.values, self._norm = state["running"], state["norm"]
        self._rng.bit_generator.state = json.loads(state["rng"])
        self._noise.set_state(state["noise"])


def train_on(
    data: Sequence[Path],
    out: Path,
    *,
    codec: str,
    start: str,
    decoder_only: bool,
    predicted_by: Sequence[Path],
    freeze_coarse: bool,
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
    decoder_only = decoder_only or bool(predicted_by) or freeze_coarse
    _check_asked(out, start, decoder_only)
    kind = CODECS[codec]
    file = CODECS[start].shipped_weights() if start in CODECS else Path(start)
    if threads:
        torch.set_num_threads(threads)
    torch.manual_seed(seed)
    trained = begun(kind, start, file)
    if freeze_coarse:
        _freeze_coarse(trained)
    predictions = EpisodePredictor(predicted_by, trained)
    loaded = {
        folder: Source(load_videos(folder, episodes), predictions.of(folder, episodes))
        for folder in dict.fromkeys(data)
    }
    record = {
        "codec": codec,
        "data": [provenance(folder, episodes) for folder in data],
        "batch": batch,
        "peak_learning_rate": peak,
        "decay": decay,
        "seed": seed,
        "start": start if start == "random" else training_record(file),
        "of_steps": steps,
        **({"decoder_only": True} if decoder_only else {}),
        **({"predicted_by": predictions.record()} if predicted_by else {}),
        **({"freeze_coarse": True} if freeze_coarse else {}),
    }
    started = start != "random"
    before = {folder: reconstruction(trained, folder) for folder in loaded if started}
    sources = [loaded[folder] for folder in data]
    training = Training(trained.train(), sources, batch=batch, seed=seed, decoder_only=decoder_only)
    state = out.with_suffix(".training")
    if state.exists():
        training.restore(state, record)
    began, names = time.monotonic(), [folder.name for folder in data]
    for step in training.steps(steps, peak, decay):
        if step % 100 == 0 or step == steps:
            save(trained, out, {**record, "steps": step})
            training.store(state, record)
            click.echo(f"step {step}, {time.monotonic() - began:.0f} s, dB: {training.told(names)}")
    state.unlink(missing_ok=True)
    tell_gain(kind(weights=str(out)), loaded, before)
    click.echo(f"{out}; use it with codec={codec} codec.weights={out}")


def _check_asked(out: Path, start: str, decoder_only: bool) -> None:
    if out.suffix != ".safetensors":
        raise DataError(f"--out {out} must end in .safetensors")
    if decoder_only and start == "random":
        raise DataError(
            "--decoder-only, --predicted-by and --freeze-coarse keep an encoder: not --start random"
        )


def tell_gain(codec: Compact, folders: Iterable[Path], before: Mapping[Path, float | None]) -> None:
    """Print the reconstruction of test episodes, and what it was before."""
    for folder in folders:
        now, old = reconstruction(codec, folder), before.get(folder)
        if now is not None:
            gain = "" if old is None else f"{old:.2f} dB before and "
            click.echo(f"{folder}: {gain}{now:.2f} dB now, on test episodes")


def begun(kind: type[Compact], start: str, file: Path) -> Compact:
    """The codec to train, in evaluation mode: `random`, from a file or from another codec.

    The weights that ship with `compact` fit into `compact_reference`, but for what it lacks.
    """
    if start not in CODECS or start == kind.name:
        return kind(weights=start if start == "random" else str(file)).eval()
    trained = kind(weights="random").eval()
    try:
        found = trained.load_state_dict(CODECS[start]().state_dict(), strict=False)
    except RuntimeError:  # sizes differ
        found = None
    if found is None or found.unexpected_keys:
        raise DataError(f"the weights of {start} do not fit into {kind.name}: leave out --start")
    return trained


def _freeze_coarse(codec: Compact) -> None:
    if not isinstance(codec, CompactReference):
        raise DataError(f"--freeze-coarse needs --codec compact_reference, not {codec.name}")
    codec.freeze_coarse()


@torch.no_grad()
def reconstruction(codec: Compact, folder: Path) -> float | None:
    """PSNR in dB of the codec's reconstruction of the first test episodes; None without any."""
    if "ind_test" not in DatasetCard.read(folder).splits:
        return None
    training, errors = codec.training, list[float]()
    codec.eval()
    tests = EpisodeDataset(folder, "ind_test")
    pixels = 0
    for index in range(len(tests)):
        video = torch.as_tensor(tests.video(index)).float()[None] / 255
        pixels += video[0, :, 0].numel()
        if errors and pixels > TEST_PIXELS:
            break
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16_is_fast()):
            decoded = codec(video).float()
        errors.append((decoded - video).square().mean().item())
    codec.train(training)
    return -10 * math.log10(max(float(np.mean(errors)), 1e-12))


def save(codec: Compact, out: Path, record: dict[str, Any]) -> None:
    """Write the weights as float16, with a record of how they were made."""
    state = codec.stored()
    check_finite(out, state)
    out.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(out) as partial:
        save_file(state, partial, metadata={"training": json.dumps(record)})
