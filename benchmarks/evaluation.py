"""Where the time of an evaluation goes: CPU-seconds of reading, predicting, scoring, summing up.

    python benchmarks/evaluation.py push_cube --out runs/evaluation_time
    python benchmarks/evaluation.py push_sand --size 64x112
    python benchmarks/evaluation.py pour_water --episodes 100 --words evaluation.protocol=acwm-phys
    python benchmarks/evaluation.py push_rope --run runs/push_rope

Runs `acwm evaluate` on a small model, from a run or untrained, in one thread, so that CPU time is
meaningful even on a busy machine. The time of sampling does not depend on the weights, but that of
metrics may: a rope is only traced if it is visible. The data is generated once and kept. The model
is evaluated twice: first as the first model on its data, then as a later one, which reuses the rows
that are the same for every model (`acwm_core.evaluation.references`). The cost of these rows is
counted separately, as it is spent once per dataset.
"""

from __future__ import annotations

import functools
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch
from rich.console import Console
from rich.table import Table

from acwm_core.cli.arguments import size
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.evaluation import evaluate, predict
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.references import KEPT, REFERENCES
from acwm_core.evaluation.results import FOLDER as EVALUATION
from acwm_core.evaluation.results import Summary
from acwm_core.model.build import build_world_model
from acwm_core.model.codec import Codec
from acwm_core.model.world_model import WorldModel
from acwm_core.recipe import compose
from acwm_core.training.run import save_weights

REFERENCE = ", reference rows"
SAMPLING, READING, CODEC = "sampling", "reading clips", "codec row"
STATES, SUMMARY, VIDEOS = "reading states", "summing up", "videos"


class Clock:
    """CPU-seconds by name; nested calls are counted only under the inner name."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._running = threading.local()

    def mark(self, owner: Any, function: str, suffix: Callable[..., str]) -> None:
        """From now on, during calls of a function, append `suffix(*arguments)` to all names."""
        original = getattr(owner, function)

        @functools.wraps(original)
        def marked(*args: Any, **kwargs: Any) -> Any:
            self._running.suffix = suffix(*args, **kwargs)
            try:
                return original(*args, **kwargs)
            finally:
                self._running.suffix = ""

        setattr(owner, function, marked)

    def wrap(self, owner: Any, method: str, name: str) -> None:
        """From now on, count the time of a method or function."""
        original = getattr(owner, method)

        @functools.wraps(original)
        def counted(*args: Any, **kwargs: Any) -> Any:
            outer, self._running.inner = getattr(self._running, "inner", 0.0), 0.0
            started = time.thread_time()
            try:
                return original(*args, **kwargs)
            finally:
                spent = time.thread_time() - started
                suffix = getattr(self._running, "suffix", "")
                self.seconds[name + suffix] += spent - self._running.inner
                self._running.inner = outer + spent

        setattr(owner, method, counted)


def instrument(clock: Clock, build_metrics: Callable[..., dict[str, Metric]]) -> Any:
    """Count the time of everything that an evaluation calls; returns the new `build_metrics`."""
    clock.mark(predict, "score", lambda made, *_: REFERENCE if made.kind in KEPT else "")
    clock.wrap(WorldModel, "rollout", SAMPLING)
    clock.wrap(Codec, "forward", CODEC)
    clock.wrap(EpisodeDataset, "__getitem__", READING)
    clock.wrap(EpisodeDataset, "actions", READING)
    clock.wrap(Prediction.__dict__["observed"], "func", STATES)
    clock.wrap(evaluate, "summarise_split", SUMMARY)
    clock.wrap(evaluate, "gap", SUMMARY)
    clock.wrap(Evaluator, "videos", VIDEOS)
    clock.wrap(evaluate, "_write", VIDEOS)

    def counted_metrics(*args: Any, **kwargs: Any) -> dict[str, Metric]:
        metrics = build_metrics(*args, **kwargs)
        for name, metric in metrics.items():
            for method in ("per_frame", "value", "weight"):
                clock.wrap(metric, method, name)
        return metrics

    return counted_metrics


def untrained_run(folder: Path, environment: str, data: Path, words: tuple[str, ...]) -> Path:
    """A run of the small recipe with random weights."""
    recipe = compose(f"{environment}.yaml", ["+small", f"data.path={data}", *words])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recipe.yaml").write_text(recipe.to_yaml())
    card = DatasetCard.read(data)
    card.write(folder)
    model = build_world_model(recipe, card.environment)
    save_weights(
        folder / "model.safetensors", model.state_dict(), model.codec.fingerprint(), step=0
    )
    return folder


def copied_run(folder: Path, run: Path) -> Path:
    """Copy a run without its evaluation; the original stays unchanged."""
    shutil.rmtree(folder, ignore_errors=True)
    return shutil.copytree(run, folder, ignore=shutil.ignore_patterns(EVALUATION, "checkpoints"))


def show(title: str, clock: Clock, total: float, summary: Summary) -> None:
    """Print the shares, largest first, and the cost of metrics compared with sampling."""
    table = Table(box=None, title=title, title_justify="left")
    for column in ("", "CPU-s", "share"):
        table.add_column(column, justify="right" if column else "left")
    clock.seconds["other"] = total - sum(clock.seconds.values())
    for name, seconds in sorted(clock.seconds.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{seconds:.1f}", f"{seconds / total:.1%}")
    Console().print(table)
    measuring = [*summary.metrics, STATES]
    own, kept = (
        sum(clock.seconds.get(name + suffix, 0.0) for name in measuring)
        for suffix in ("", REFERENCE)
    )
    clips = sum(split.scores.clips for split in summary.splits.values())
    print(
        f"{clips} clips: {total:.0f} CPU-s, sampling {clock.seconds[SAMPLING]:.1f}, metrics of "
        f"predictions {own:.1f}, of reference rows {kept:.1f}"
    )


@click.command()
@click.argument("environment", default="push_cube")
@click.option("--episodes", default=100, show_default=True, help="Of each of the two test splits.")
@click.option("--out", type=Path, default=Path("runs/evaluation_time"), show_default=True)
@click.option("--size", type=size, default="64", show_default=True, help="64 or HEIGHTxWIDTH.")
@click.option("--data", type=Path, help="A data folder to use instead of generating one.")
@click.option("--run", type=Path, help="A trained run, whose data is used unless --data is given.")
@click.option("--words", multiple=True, help="Words of the recipe, such as evaluation.steps=10.")
def main(
    environment: str,
    episodes: int,
    out: Path,
    size: int | tuple[int, int],
    data: Path | None,
    run: Path | None,
    words: tuple[str, ...],
) -> None:
    """Evaluate a small model of ENVIRONMENT and say where the time went."""
    torch.set_num_threads(1)
    if data is None and run:
        data = Path(compose(run / "recipe.yaml", []).data["path"])
    if data is None:
        data = out / f"{environment}_{episodes}"
        counts = {"train": 1, "ind_test": episodes, "ood_test": episodes}
        generate(environment, data, episodes=counts, size=size)
    place = out / f"{environment}_run"
    if run:
        copied_run(place, run)
    else:
        untrained_run(place, environment, data, words)
    clock = Clock()
    evaluate.build_metrics = instrument(clock, evaluate.build_metrics)
    shutil.rmtree(data / REFERENCES, ignore_errors=True)
    for title in ("The first model on this data", "A later one"):
        clock.seconds.clear()
        started = time.process_time()
        summary = evaluate.evaluate_run(place, data=data, overrides=words if run else ())
        show(title, clock, time.process_time() - started, summary)


if __name__ == "__main__":
    main()
