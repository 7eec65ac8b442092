"""Trains the network that reads one's own world, and measures how well it does."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.physics import StateEstimator
from acwm_core.env.rotations import angle_difference
from acwm_core.evaluation.clips import as_clip
from acwm_estimators.estimator import FittedEstimator
from acwm_estimators.fitted import fitted_layout
from acwm_estimators.layout import Layout
from acwm_estimators.network import StateNetwork
from acwm_estimators.train import all_frames, provenance, save, train

BATCH, PEAK = 24, 3e-3
"""Small frames per step, and the peak learning rate."""

TRIED = 8
"""Episodes on which errors are measured."""

EVERY = 100
"""Steps between lines about the progress."""


def train_fitted(
    data: Path, out: Path, angles: Mapping[str, int], *, steps: int, episodes: int, seed: int
) -> Iterator[str]:
    """Train on the masks and states of a dataset and write the weights.

    Args:
        data: a dataset with masks and positions.
        out: the weights file to write.
        angles: see `fitted_layout`.
        steps: optimiser steps.
        episodes: training episodes to use at most.
        seed: of the weights and of the order of frames.

    Yields:
        Lines about what is read, the progress and, at the end, the errors.

    Raises:
        DataError: the dataset has no masks, or no position that they show.
    """
    dataset = EpisodeDataset(data, "train")
    layout = fitted_layout(dataset, angles, episodes)
    declared = dataset.card.environment.camera is not None
    yield f"camera: {'as the card declares' if declared else 'fitted, as the card declares none'}"
    for points in layout.points:
        yield f"{points.field}: {', '.join(points.instances)}"
    torch.manual_seed(seed)
    network = StateNetwork(layout)
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    sources = all_frames([data], layout, episodes)
    names = sources[0].targets
    network.calibrate({name: np.concatenate([s.targets[name] for s in sources]) for name in names})
    began = time.monotonic()
    for step, parts in train(network, sources, steps, BATCH, PEAK, seed):
        if step % EVERY == 0 or step == steps:
            seconds = time.monotonic() - began
            yield f"step {step}/{steps}, {seconds:.0f} s: loss {sum(parts.values()):.3f}"
    record = {"data": [provenance(data, episodes)], "steps": steps, "seed": seed}
    save(network, out, {**record, "layout": asdict(layout)})
    yield from _errors(data, out, layout)


def _errors(data: Path, weights: Path, layout: Layout) -> Iterator[str]:
    """Errors on a test split, or on the last training episodes if there is none."""
    card = DatasetCard.read(data)
    split = "ind_test" if card.splits.get("ind_test") else "train"
    dataset = EpisodeDataset(data, split)
    estimator = FittedEstimator(card.environment, weights=weights)
    count = len(dataset)
    tried = range(count)[:TRIED] if split == "ind_test" else range(max(0, count - TRIED), count)
    seen = [_compared(estimator, dataset, index, layout) for index in tried]
    where = f"on {len(tried)} episodes of {split}"
    units = {field.name: field.unit for field in card.environment.state}
    for name in seen[0]:
        values = np.concatenate([each[name] for each in seen])
        if name in units:
            found = np.isfinite(values)
            median = float(np.median(values[found])) if found.any() else float("nan")
            yield f"{name}: off by {median:.3g} {units[name]} {where}, seen in {found.mean():.0%}"
        else:
            yield f"masks of {name}: IoU {np.nanmean(values):.2f} {where}"


def _compared(
    estimator: StateEstimator, dataset: EpisodeDataset, index: int, layout: Layout
) -> dict[str, np.ndarray]:
    """Distances of positions, and the overlap of masks, in each frame of an episode."""
    episode = dataset[index]
    seen = estimator.read(as_clip(episode.video))
    errors: dict[str, np.ndarray] = {}
    for points in layout.points:
        off = seen.states[points.field] - episode.states[points.field]
        errors[points.field] = np.linalg.norm(off, axis=-1).reshape(-1)
    for local in layout.locals:
        angles = seen.states[local.field], episode.states[local.field]
        errors[local.field] = np.abs(angle_difference(*angles, local.fold)).reshape(-1)
    instances = dataset.card.environment.instances
    for name in layout.instances:
        true, found = (masks == instances.index(name) for masks in (episode.masks, seen.masks))
        either = (true | found).sum((1, 2))
        both = (true & found).sum((1, 2))
        errors[name] = np.where(either > 0, both / np.maximum(either, 1), np.nan)
    return errors
