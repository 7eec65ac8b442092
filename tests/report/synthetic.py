"""Evaluated runs with scores of one's choice, as `acwm evaluate` would leave them."""

import numpy as np

from acwm_core.evaluation.metric import Metric
from acwm_core.evaluation.results import FOLDER, Score, Summary
from acwm_core.evaluation.storage import EPISODES, write_scores
from acwm_core.evaluation.summarise import gap, summarise_split

SEED, FRAMES, FPS = 0, 5, 10


class Error(Metric):
    name = "mse"
    title = "MSE"
    reads = "pixels"
    factor = 1000.0

    def per_frame(self, rollout):
        raise NotImplementedError  # the scores are given


class Quality(Error):
    name = "psnr"
    title = "PSNR"
    factor = None
    unit = "dB"
    higher_is_better = True


METRICS = {"mse": Error(), "psnr": Quality()}


def clip(kind, episode, psnr, *, split="ind_test", start=0, frames=FRAMES):
    error = 10.0 ** (-psnr / 10)
    return Score(
        split=split,
        episode=episode,
        start=start,
        ood_label="mass" if split == "ood_test" else None,
        kind=kind,
        frames=frames,
        values={"mse": error, "psnr": psnr},
        weights={"mse": 1.0, "psnr": 1.0},
        curves={"mse": [error] * frames, "psnr": [psnr] * frames},
    )


def clips(scores, split="ind_test", starts=(0,)):
    """All rows of a split; `scores` are the model's PSNR per episode, `[N]` or `[N, starts]`."""
    scores = np.asarray(scores, dtype=float).reshape(len(scores), -1)
    offsets = {"model": 0.0, "shuffled": -1.0, "copy": -3.0, "codec": 8.0}
    return [
        clip(kind, episode, scores[episode, index] + offset, split=split, start=start)
        for episode in range(len(scores))
        for index, start in enumerate(starts)
        for kind, offset in offsets.items()
    ]


def run(path, results, *, environment="drift", protocol="full", **provenance):
    """Write an evaluated run of these clips and return its folder."""
    splits = {}
    for each in results:
        splits.setdefault(each.split, []).append(each)
    summaries = {s: summarise_split(rows, METRICS, SEED) for s, rows in splits.items()}
    both = {"ind_test", "ood_test"} <= set(splits)
    summary = Summary(
        run=path.name,
        parts={"env": environment, "codec": "compact", "model": "dit", "conditioner": "adaln"},
        metrics={n: m.info for n, m in METRICS.items()},
        headline="psnr",
        splits=summaries,
        gap=gap(splits["ind_test"], splits["ood_test"], METRICS, SEED) if both else {},
        environment={
            "name": environment,
            "summary": "a square that drifts",
            "fps": FPS,
            "action": {"names": ["dx"], "units": ["px"], "low": [-2.0], "high": [2.0]},
            "citation": "",
        },
        provenance=facts(**provenance),
        protocol=protocol,
    )
    folder = path / FOLDER
    folder.mkdir(parents=True)
    (path / "recipe.yaml").write_text("model: dit\n")
    write_scores(folder / EPISODES, results)
    summary.write(folder)
    return path


def facts(
    checksums=None,
    steps=5,
    settings=None,
    version="0.1.0",
    weights="w" * 64,
    estimator=None,
    given=1,
    planned=None,
    dataset=None,
):
    """Where the numbers come from."""
    return {
        "evaluated": "2026-01-02T03:04:05+00:00",
        "recipe_sha256": "r" * 64,
        "recipe": "model: dit\n",
        "weights_sha256": weights,
        "training_steps": 200,
        "planned_steps": planned,
        "context_frames": given,
        "imported": None,
        "parameters": 1_900_000,
        "codec_fingerprint": "compact-1",
        "evaluation": {"frames": None, "cuts": None, "episodes": None, "seed": 0}
        | (settings or {}),
        "sampling_steps": steps,
        "estimator": estimator,
        "dataset": {
            "path": "data/drift",
            "environment": "drift",
            "frame_size": [32, 32],
            "episodes": {"ind_test": 20, "ood_test": 20},
            "seed": 0,
            "options": {},
            "source": {},
            "command": "acwm generate drift --out data/drift",
            "factors": {},
            "checksums": checksums or {"ind_test": "a" * 64, "ood_test": "b" * 64},
            "versions": {},
        }
        | (dataset or {}),
        "versions": {"acwm": version, "python": "3.11", "torch": "2"},
        "device": "cpu (Linux x86_64, 1 threads)",
        "seconds": 1.0,
    }
