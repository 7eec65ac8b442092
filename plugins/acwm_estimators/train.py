"""Train the weights of one estimator; the file records data and seed (docs/estimators.md).

    python -m acwm_estimators.train push_cube --data data/a --data data/b --out a.safetensors

Every step uses frames of one dataset, some of them degraded to look like predictions. An estimator
is a measuring instrument and has to read everything that models are tested on. So train it on
datasets with all factors, in and out of distribution, with other seeds than the test splits.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from acwm_core.data.card import DatasetCard
from acwm_core.errors import RecipeError, suggest
from acwm_core.plugins import catalog
from acwm_estimators.frames import LabelledFrames, draw, load_frames, reconstructed
from acwm_estimators.layout import Layout, layout_of
from acwm_estimators.losses import losses
from acwm_estimators.network import StateNetwork
from acwm_estimators.plugin import WEIGHTS

WARM_UP = 30  # steps
SMALL = 128  # pixels; frames up to this height come in larger batches
SETTLED = 0.5
CODEC = "compact"  # its reconstructions are used for training, too
RECONSTRUCTED = {True: (8, 13), False: (2, 5)}  # clips and frames per clip, if frames are small


def all_frames(folders: Sequence[Path], layout: Layout, most: int) -> list[LabelledFrames]:
    """The frames of every dataset, and codec reconstructions of some of them."""
    codec = catalog().create("codec", CODEC).eval()
    found: list[LabelledFrames] = []
    for folder in folders:
        frames = load_frames(folder, layout, most)
        clips, length = RECONSTRUCTED[frames.video.shape[1] <= SMALL]
        sides = frames.video.shape[1:3]
        can_encode = not any(side % codec.spatial_stride for side in sides)
        found += [frames, reconstructed(frames, codec, clips, length) if can_encode else frames]
    return found


def chances(sources: Sequence[LabelledFrames]) -> np.ndarray:
    """Probability of each source: the same for small and large frames, less for reconstructions."""
    weights = np.array([1.0 if index % 2 == 0 else 0.25 for index in range(len(sources))])
    small = np.array([source.video.shape[1] <= SMALL for source in sources])
    for group in (small, ~small):
        weights[group] /= max(weights[group].sum(), 1e-9)
    return weights / weights.sum()


def train(
    network: StateNetwork,
    sources: Sequence[LabelledFrames],
    steps: int,
    batch: int,
    peak: float,
    seed: int,
    settled: float = SETTLED,
) -> Iterator[tuple[int, dict[str, float]]]:
    """Train in place; yields the number of steps done and the parts of the loss.

    After the share `settled` of the steps, features are normalised with running statistics, as in
    inference: the statistics of the current batch would reveal its dataset.
    """
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.AdamW(network.parameters(), betas=(0.9, 0.99), weight_decay=1e-4)
    likely = chances(sources)
    network.train()
    for step in range(1, steps + 1):
        if step > settled * steps:
            settle(network)
        rate = peak * min(1.0, step / WARM_UP, (steps - step + 1) / (0.7 * steps))
        for group in optimizer.param_groups:
            group["lr"] = rate
        source = sources[int(rng.choice(len(sources), p=likely))]
        small = source.video.shape[1] <= SMALL
        video, classes, targets = draw(source, batch if small else batch // 2, rng)
        parts = losses(network(video), classes, targets, network.layout, rng)
        loss = torch.stack(list(parts.values())).sum()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        yield step, {name: value.item() for name, value in parts.items()}


def settle(network: nn.Module) -> None:
    """Normalise with the running statistics from now on."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def provenance(folder: Path, most: int) -> dict[str, Any]:
    """The settings with which `acwm generate` can make a dataset again."""
    card = DatasetCard.read(folder)
    return {
        "environment": card.environment.name,
        "frame_size": list(card.environment.frame_size),
        "factors": dict(card.factors),
        "seed": card.seed,
        "episodes": min(most, card.splits["train"]),
    }


def save(network: StateNetwork, out: Path, record: dict[str, Any]) -> None:
    """Write the weights as float16, with a record of how they were made."""
    state = {
        name: value.half().contiguous()
        for name, value in network.state_dict().items()
        if value.is_floating_point()
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file(state, out, metadata={"training": json.dumps(record)})


@click.command()
@click.argument("name", metavar="ENVIRONMENT")
@click.option("--data", multiple=True, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True)
@click.option("--steps", default=1200, show_default=True)
@click.option("--batch", default=24, show_default=True, help="Small frames per step.")
@click.option("--peak", default=3e-3, show_default=True, help="Peak learning rate.")
@click.option("--episodes", default=200, show_default=True, help="Episodes read per dataset.")
@click.option("--seed", default=0, show_default=True)
@click.option("--start", type=click.Path(path_type=Path), help="Weights to start from.")
def main(
    name: str,
    data: tuple[Path, ...],
    out: Path,
    steps: int,
    batch: int,
    peak: float,
    episodes: int,
    seed: int,
    start: Path | None,
) -> None:
    """Train the estimator of ENVIRONMENT on the training splits of --data and write --out."""
    if name not in WEIGHTS:
        raise RecipeError(f"there is no layout for {name!r}{suggest(name, WEIGHTS)}")
    torch.manual_seed(seed)
    network = StateNetwork(layout_of(name))
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    began = time.monotonic()
    sources = all_frames(data, layout_of(name), episodes)
    network.calibrate(
        {
            key: np.concatenate([source.targets[key] for source in sources])
            for key in sources[0].targets
        }
    )
    record = {
        "data": [provenance(folder, episodes) for folder in data],
        "steps": steps,
        "batch": batch,
        "peak_learning_rate": peak,
        "seed": seed,
    }
    if start:
        from acwm_core.files import training_record
        from acwm_estimators.weights import load

        load(network, start)
        record["start"] = training_record(start)
    click.echo(f"{sum(len(s.video) for s in sources)} frames, {time.monotonic() - began:.0f} s")
    settled = 0.0 if start else SETTLED
    for step, parts in train(network, sources, steps, batch, peak, seed, settled):
        if step % 50 == 0 or step == steps:
            said = ", ".join(f"{part} {value:.3f}" for part, value in parts.items())
            click.echo(f"step {step}, {time.monotonic() - began:.0f} s: {said}")
        if step % 300 == 0 or step == steps:
            save(network, out, {**record, "done": step})


if __name__ == "__main__":
    main()
