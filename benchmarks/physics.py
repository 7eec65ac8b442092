"""Scores of the true video in the physics metrics, and the cost of these metrics.

    python benchmarks/physics.py data/push_cube data/reacher --clips 24

Each row is a split of a dataset: the floor (or ceiling) of any model's score, because the estimator
makes errors too.
"""

from __future__ import annotations

import time
from collections import defaultdict
from pathlib import Path
from typing import cast

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Split
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.evaluation.score import estimator_for
from acwm_core.plugins import catalog
from acwm_metrics.plugin import PHYSICS


@click.command()
@click.argument("folders", nargs=-1, type=Path)
@click.option("--clips", default=24, show_default=True, help="episodes per split")
def main(folders: tuple[Path, ...], clips: int) -> None:
    """Print a table of floors, and of seconds per clip for reading and for all metrics."""
    metrics = {name: cast(Metric, catalog().create("metric", name)) for name in PHYSICS}
    table = Table("data", "split", *PHYSICS, "reading s", "metrics s")
    for folder in folders:
        for split in ("ind_test", "ood_test"):
            table.add_row(folder.name, split, *row(folder, split, metrics, clips))
    Console(width=240).print(table)


def row(folder: Path, split: Split, metrics: dict[str, Metric], clips: int) -> list[str]:
    """The cells of a row: summaries of all metrics, and the two times."""
    episodes = EpisodeDataset(folder, split)
    card = episodes.card.environment
    estimator = estimator_for(card)
    if estimator is None:
        raise click.ClickException(f"no estimator reads the video of {card.name}")
    scores: dict[str, list[tuple[float, float]]] = defaultdict(list)
    reading = measuring = 0.0
    count = min(clips, len(episodes))
    for index in range(count):
        prediction = Prediction.truth(episodes[index], card, estimator)
        started = time.process_time()
        _ = prediction.observed
        read = time.process_time()
        for name, metric in metrics.items():
            if metric.unavailable(card, estimator) is None:
                scores[name].append((metric.value(prediction), metric.weight(prediction)))
        reading, measuring = reading + read - started, measuring + time.process_time() - read
    found = [_summary(metric, scores[name]) for name, metric in metrics.items()]
    return [*found, f"{reading / count:.2f}", f"{measuring / count:.2f}"]


def _summary(metric: Metric, scores: list[tuple[float, float]]) -> str:
    defined = [pair for pair in scores if not np.isnan(pair[0])]
    return f"{metric.summarise(*zip(*defined, strict=True)):.4g}" if defined else "–"


if __name__ == "__main__":
    main()
