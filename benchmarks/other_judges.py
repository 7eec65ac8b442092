"""What other programs say about the videos of `benchmarks/first_table.py`.

    pip install worldbench wamprobe
    python benchmarks/other_judges.py --out runs/first_table reacher push_cube

WorldBench compares frames (`visual_similarity`, of 100) and judges how steadily they change
(`temporal_stability`, of 100). WAMProbe compares how far the last frames of several action
sequences from one start are apart with how far they truly are (a correlation, its action
dependence). Beside them are acwm's own PSNR and response of the same videos.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.stats import spearmanr
from wamprobe.metrics import action_dependence_permutation_vectors
from worldbench.metrics.temporal import TemporalStabilityMetric
from worldbench.metrics.visual import VisualSimilarityMetric

import acwm
from acwm_core.data.simulate import make_environment, simulate

POOL = 8
"""Pixels per side of the blocks that a last frame is averaged over, as a vector of its state."""

COLUMNS = ("psnr", "response", "visual_similarity", "temporal_stability", "action_dependence")


@click.command()
@click.argument("worlds", nargs=-1, required=True)
@click.option("--out", type=click.Path(path_type=Path), default=Path("runs/first_table"))
def main(worlds: tuple[str, ...], out: Path) -> None:
    """Print a row per world and method, and how far the judges' orders agree."""
    rows: list[dict[str, Any]] = []
    print("| World | Method | " + " | ".join(COLUMNS) + " |\n|" + " --- |" * (2 + len(COLUMNS)))
    for world in worlds:
        truth = out / "tasks" / f"{world}-truth" / world
        episodes = acwm.EpisodeDataset(truth, "ind_test")
        contexts = list(branched(out / "tasks" / world, episodes))
        for scores in sorted((out / "scores").glob(f"*/{world}/evaluation/summary.json")):
            method = scores.parents[2].name
            if method == "codec":
                continue  # it has no branches
            predictions = out / "predictions" / world / method
            row = own_scores(scores) | videos(predictions, world, episodes)
            row["action_dependence"] = dependence(predictions, contexts)
            rows.append(row)
            cells = " | ".join(f"{row[name]:.2f}" for name in COLUMNS)
            print(f"| {world} | {method} | {cells} |", flush=True)
    for own, other in (("psnr", COLUMNS[2]), ("psnr", COLUMNS[3]), ("response", COLUMNS[4])):
        order: Any = spearmanr([row[own] for row in rows], [row[other] for row in rows])
        print(f"\nSpearman of {own} and {other}: {order.statistic:.2f} ({len(rows)} rows)")


def own_scores(summary: Path) -> dict[str, float]:
    """PSNR and response in distribution, as `acwm score` wrote them."""
    split = json.loads(summary.read_text())["splits"]["ind_test"]
    response = split["counterfactual"]["rows"]["model"]["response"]["value"]
    return {"psnr": split["scores"]["rows"]["model"]["psnr"]["value"], "response": response}


def videos(predictions: Path, world: str, episodes: acwm.EpisodeDataset) -> dict[str, float]:
    """Mean scores of WorldBench over the clips, without the given frame."""
    visual, temporal = list[float](), list[float]()
    for number in range(len(episodes)):
        predicted = sorted((predictions / world / f"ind_test-{number:06d}").glob("*.png"))[1:]
        with tempfile.TemporaryDirectory() as folder:
            true = [Path(folder) / path.name for path in predicted]
            for path, frame in zip(true, episodes[number].video[1:], strict=True):
                Image.fromarray(frame).save(path)
            episode: Any = SimpleNamespace(frames=true)
            visual.append(judged(VisualSimilarityMetric(), episode, predicted))
            temporal.append(judged(TemporalStabilityMetric(), episode, predicted))
    return {
        "visual_similarity": float(np.mean(visual)),
        "temporal_stability": float(np.mean(temporal)),
    }


def judged(metric: Any, episode: Any, predicted: list[Path]) -> float:
    """The score of a metric of WorldBench, from 0 to 100."""
    score = metric.evaluate(episode, predicted).score
    assert score is not None, f"{metric.name} has no score"
    return score


def branched(
    tasks: Path, episodes: acwm.EpisodeDataset
) -> Iterator[list[tuple[str, NDArray[np.float32]]]]:
    """By start, the tasks with other actions from there, and the true last frame of each."""
    lines = [json.loads(line) for line in (tasks / "index.jsonl").read_text().splitlines()]
    branches = [line for line in lines if line["branch"] and "ind_test" in line["id"]]
    environment = make_environment(episodes.card.environment.name, episodes.card.options)
    for start in sorted({line["id"].rsplit("-branch-", 1)[0] for line in branches}):
        spec, context = episodes[int(start[-6:])].spec, list[tuple[str, NDArray[np.float32]]]()
        for line in branches:
            if line["id"].startswith(f"{start}-branch-"):
                actions = np.load(tasks / line["actions"])["actions"]
                made = simulate(environment, spec, actions, frames=line["frames"])
                context.append((line["id"], pooled(made.video[-1])))
        yield context
    environment.close()


def dependence(
    predictions: Path, contexts: Sequence[Sequence[tuple[str, NDArray[np.float32]]]]
) -> float:
    """Mean action dependence of WAMProbe over the starts."""
    values = list[float]()
    for context in contexts:
        ends = [sorted((predictions / name).glob("*.png"))[-1] for name, _ in context]
        predicted = [pooled(np.asarray(Image.open(end, formats=["PNG"]))).tolist() for end in ends]
        true = [frame.tolist() for _, frame in context]
        result = action_dependence_permutation_vectors(
            predicted_endpoints=predicted, truth_endpoints=true
        )
        values.append(result.observed)
    return float(np.mean(values))


def pooled(frame: NDArray[np.uint8]) -> NDArray[np.float32]:
    """A frame `[H, W, 3]` averaged over blocks, as a vector."""
    height, width = (side // POOL * POOL for side in frame.shape[:2])
    blocks = frame[:height, :width].reshape(height // POOL, POOL, width // POOL, POOL, 3)
    return (blocks.mean((1, 3)) / 255).astype(np.float32).ravel()


if __name__ == "__main__":
    main()
