"""Where results come from, and a cache of the reference rows, which are the same every time."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import torch

import acwm_core
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import ClipResult, read_rows, write_results
from acwm_core.evaluation.clips import ClipPlan, Predictor
from acwm_core.evaluation.evaluator import Evaluator
from acwm_core.evaluation.scoring import measure_facts, predictors_for
from acwm_core.recipe import Recipe
from acwm_core.training.run import RunFolder, read_metadata

REFERENCES = "references"

KEPT: tuple[Predictor, ...] = ("copy", "codec", "truth")
"""The rows that are the same for all models with the same codec, and are therefore cached."""


def provenance(
    folder: RunFolder, recipe: Recipe, evaluator: Evaluator, datasets: Mapping[str, EpisodeDataset]
) -> dict[str, Any]:
    """Everything needed to reproduce the results, as JSON types."""
    world_model, config, device = evaluator.world_model, evaluator.config, evaluator.device
    dataset = next(iter(datasets.values()))
    card = dataset.card
    facts = read_metadata(folder.weights)
    machine = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    on_gpu = device.type == "cuda"
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    return {
        "evaluated": datetime.now(UTC).isoformat(timespec="seconds"),
        "recipe_sha256": file_sha256(folder.recipe),
        "recipe": recipe.to_yaml(),
        "weights_sha256": file_sha256(folder.weights),
        "training_steps": facts["step"],
        "imported": facts.get("imported"),
        "parameters": sum(parameter.numel() for parameter in trained),
        "codec_fingerprint": world_model.codec.fingerprint(),
        "evaluation": asdict(config),
        "sampling_steps": config.steps or world_model.objective.steps or 1,
        "mode": config.mode or world_model.mode,
        "context_frames": evaluator.given,
        "dataset": {
            "path": str(dataset.path),
            "environment": card.environment.name,
            "frame_size": list(card.environment.frame_size),
            "episodes": dict(card.splits),
            "seed": card.seed,
            "options": dict(card.options),
            "source": dict(card.source),
            "command": card.command(dataset.path),
            "factors": dict(card.factors),
            "checksums": {split: each.checksum for split, each in datasets.items()},
            "versions": dict(card.versions),
        },
        "versions": {
            "acwm": acwm_core.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "device": torch.cuda.get_device_name(device) if on_gpu else f"{device.type} ({machine})",
        **measure_facts(evaluator.metrics, evaluator.estimator),
    }


def scores_with_references(
    evaluator: Evaluator, plans: Sequence[ClipPlan], episodes: EpisodeDataset
) -> list[ClipResult]:
    """What `Evaluator.scores` returns, with the rows of `KEPT` read from the cache.

    If they are not cached yet, they are computed and cached for the next evaluation, provided that
    the data folder is writable.
    """
    file = references_file(evaluator, plans, episodes)
    found: list[ClipResult] = []
    with contextlib.suppress(DataError, FileNotFoundError):  # damaged, or not there yet
        found = read_rows(file) if file else []
    kept: list[Predictor] = [each for each in evaluator.predictors if each in KEPT]
    wanted = {(p.episode, p.start, k, p.frames) for p in plans for k in predictors_for(p, kept)}
    made_here = (r.split == episodes.split and {*r.values} == {*evaluator.metrics} for r in found)
    if {(r.episode, r.start, r.kind, r.frames) for r in found} != wanted or not all(made_here):
        found = []  # from someone else, who may also have made up rows of the model
    rest: list[Predictor] = [each for each in evaluator.predictors if not found or each not in KEPT]
    made = evaluator.scores(plans, episodes, rest)
    evaluator.advance(len(found))
    if file and not found:
        with contextlib.suppress(OSError, DataError):  # e.g. a read-only dataset
            file.parent.mkdir(exist_ok=True)
            write_results(file, [row for row in made if row.kind in KEPT])
    rows = {(row.episode, row.start, row.kind): row for row in [*made, *found]}
    places = [(p.episode, p.start, kind) for p in plans for kind in evaluator.predictors]
    return [rows[place] for place in places if place in rows]


def references_file(
    evaluator: Evaluator, plans: Sequence[ClipPlan], episodes: EpisodeDataset
) -> Path | None:
    """The cache file for the rows of these clips; None if the code behind them cannot be hashed.

    Its name contains a hash of everything they depend on, so it is never out of date. The folder
    may be deleted.
    """
    codec, estimator = evaluator.world_model.codec, evaluator.estimator
    components = [codec, *evaluator.metrics.values()]
    packages = {type(each).__module__.partition(".")[0] for each in components}
    packages |= {acwm_core.__name__, *(estimator.packages() if estimator else ())}
    hashes = {name: package_hash(name) for name in sorted(packages)}
    if None in hashes.values():
        return None
    facts: dict[str, Any] = {
        "data": episodes.checksum,
        "clips": [(p.episode, p.start, p.frames, p.noise_floor, p.given) for p in plans],
        "codec": codec.fingerprint(),
        "device": evaluator.device.type,
        "metrics": list(evaluator.metrics),
        "measures": measure_facts(evaluator.metrics, estimator),
        "options": [evaluator.config.metrics, evaluator.config.metric_options],
        "code": hashes,
        "installed": sorted(f"{each.name} {each.version}" for each in distributions()),
    }
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    return episodes.path / REFERENCES / f"{episodes.split}-{key[:16]}.parquet"


@cache
def package_hash(name: str) -> str | None:
    """The hash of all files of a top-level package or module; None if it has no files.

    All files count, since a metric may depend on any: its code, weights, or a table of thresholds.
    """
    try:
        spec = importlib.util.find_spec(name) if name != "__main__" else None
    except ValueError:  # for a module that was created in memory
        spec = None
    if spec is None or not spec.origin:
        return None
    origin = Path(spec.origin)
    files = [origin]
    if spec.submodule_search_locations:
        files = sorted(
            f for f in origin.parent.rglob("*") if f.is_file() and "__pycache__" not in f.parts
        )
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.relative_to(origin.parent)}\0{file_sha256(file)}".encode())
    return digest.hexdigest()
