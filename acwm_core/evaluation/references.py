"""A cache of the reference rows: they are the same for all models with the same codec.

It lies in the user's own cache and never beside the data, which may come from somebody else."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
from collections.abc import Sequence
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import acwm_core
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.remote import cache_folder, origin
from acwm_core.data.shards import file_sha256, shard_name
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import DRAWN, Clip, Predictor
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Score
from acwm_core.evaluation.score import measure_facts
from acwm_core.evaluation.storage import load_scores, write_scores

REFERENCES = "references"

KEPT: tuple[Predictor, ...] = ("copy", "codec", "truth")
"""The rows that do not depend on the model."""


def scores_with_references(
    evaluator: Evaluator, clips: Sequence[Clip], episodes: EpisodeDataset
) -> list[Score]:
    """What `Evaluator.scores` returns, with the rows of `KEPT` read from the cache.

    If they are not cached yet, they are computed and cached for the next evaluation, provided that
    the user's cache is writable.
    """
    file = references_file(evaluator, clips, episodes)
    stored: list[Score] = []
    with contextlib.suppress(DataError, FileNotFoundError):  # damaged, or not there yet
        stored = load_scores(file) if file else []
    asked: list[Predictor] = [k for k in evaluator.predictors if not stored or k not in KEPT]
    scores = evaluator.scores(clips, episodes, asked)
    evaluator.advance(len(stored))
    if file and not stored:
        with contextlib.suppress(OSError, DataError):  # e.g. a read-only cache
            file.parent.mkdir(parents=True, exist_ok=True)
            write_scores(file, [score for score in scores if score.kind in KEPT])
    rows = {(row.episode, row.start, row.kind): row for row in [*stored, *scores]}
    kinds = dict.fromkeys(("model", *DRAWN, *evaluator.predictors))
    places = [(c.episode, c.start, kind) for c in clips for kind in kinds]
    return [rows[place] for place in places if place in rows]


def references_file(
    evaluator: Evaluator, clips: Sequence[Clip], episodes: EpisodeDataset
) -> Path | None:
    """The cache file for the rows of these clips; None if the code behind them cannot be hashed.

    Its name contains a hash of everything they depend on, so it is never out of date. That includes
    where the data lie and when they were written, because a checksum that comes with them is a
    claim. The folder may be deleted.
    """
    codec, estimator = evaluator.world_model.codec, evaluator.estimator
    components = [codec, *evaluator.metrics.values()]
    packages = {type(component).__module__.partition(".")[0] for component in components}
    packages |= {acwm_core.__name__, *(estimator.packages() if estimator else ())}
    hashes = {name: package_hash(name) for name in sorted(packages)}
    if None in hashes.values():
        return None
    facts: dict[str, Any] = {
        "data": [episodes.checksum, *_files(episodes)],
        "clips": [(c.episode, c.start, c.frames, c.noise_floor, c.given) for c in clips],
        "codec": codec.fingerprint(),
        "device": evaluator.device.type,
        "metrics": list(evaluator.metrics),
        "measures": measure_facts(evaluator.metrics, estimator),
        "options": [evaluator.config.metrics, evaluator.config.metric_options],
        "code": hashes,
        "installed": installed_packages(),
    }
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    return cached(f"{episodes.split}-{key[:16]}.parquet")


def cached(name: str) -> Path:
    """The place of a file in the user's cache of references."""
    return cache_folder() / REFERENCES / name


def _files(episodes: EpisodeDataset) -> list[Any]:
    """Where the shards lie, with sizes and dates; those behind a URL are checked when fetched."""
    folder = (episodes.path / episodes.split).resolve()
    if origin(episodes.path) is not None:
        return [str(folder)]
    shards = [folder / shard_name(number) for number in range(len(episodes.shards))]
    states = [path.stat() if path.exists() else None for path in shards]
    return [str(folder), *(stat and (stat.st_size, stat.st_mtime_ns) for stat in states)]


@cache
def installed_packages() -> list[str]:
    """Name and version of everything that is installed; reading that takes most of a second."""
    packages = (package.metadata for package in distributions())
    return sorted(f"{facts['Name']} {facts['Version']}" for facts in packages)


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
