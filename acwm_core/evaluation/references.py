"""Rows that no model has a part in: scored once for a dataset, and kept with it.

They lie in ``DATA/references/<split>-<key>.parquet``. The key is a hash of all that they depend
on: the data, the clips, the codec, the metrics and their options, all files of the packages that
measure, and the versions of all that is installed. Whatever changes gives another file, so none is
out of date; the folder may be deleted.
"""

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
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import ClipResult, read_rows, write_results
from acwm_core.evaluation.evaluator import Advance, Evaluator
from acwm_core.evaluation.plans import ClipPlan
from acwm_core.evaluation.protocol import Kind
from acwm_core.evaluation.scoring import measure_facts

FOLDER = "references"

CACHE = "__pycache__"

KEPT: tuple[Kind, ...] = ("copy", "codec", "truth")
"""The rows that are the same for every model of a codec."""


def scores_with_references(
    evaluator: Evaluator,
    plans: Sequence[ClipPlan],
    episodes: EpisodeDataset,
    advance: Advance | None = None,
) -> list[ClipResult]:
    """What `Evaluator.scores` returns, with the rows of `KEPT` as an earlier evaluation left them.

    Where there was none, they are left for the next one, if the data can be written to.
    """
    file = references_file(evaluator, plans, episodes)
    found = _read(file)
    rest: list[Kind] = [kind for kind in evaluator.kinds if not found or kind not in KEPT]
    made = evaluator.scores(plans, episodes, advance, rest)
    if found:
        if advance:
            advance(len(found))
    elif file:
        with contextlib.suppress(OSError):  # such as a dataset that may only be read
            file.parent.mkdir(exist_ok=True)
            write_results(file, [row for row in made if row.kind in KEPT])
    order = {(plan.episode, plan.start): place for place, plan in enumerate(plans)}
    kinds: list[str] = list(evaluator.kinds)
    return sorted(
        [*made, *found], key=lambda row: (order[row.episode, row.start], kinds.index(row.kind))
    )


def references_file(
    evaluator: Evaluator, plans: Sequence[ClipPlan], episodes: EpisodeDataset
) -> Path | None:
    """Where the rows of these clips are kept; None if it cannot be told what measures them."""
    codec, estimator = evaluator.world_model.codec, evaluator.estimator
    components = [codec, *evaluator.metrics.values()]
    packages = {type(each).__module__.partition(".")[0] for each in components}
    packages |= {acwm_core.__name__, *(estimator.packages() if estimator else ())}
    hashes = {name: package_hash(name) for name in sorted(packages)}
    if None in hashes.values():
        return None
    facts: dict[str, Any] = {
        "data": episodes.checksum,
        "clips": [(plan.episode, plan.start, plan.frames, plan.floor) for plan in plans],
        "codec": codec.fingerprint(),
        "device": evaluator.world_model.action_low.device.type,
        "metrics": list(evaluator.metrics),
        "measures": measure_facts(evaluator.metrics, estimator),
        "options": [evaluator.config.metrics, evaluator.config.metric_options],
        "code": hashes,
        "installed": sorted(f"{each.name} {each.version}" for each in distributions()),
    }
    key = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    return episodes.path / FOLDER / f"{episodes.split}-{key[:16]}.parquet"


@cache
def package_hash(name: str) -> str | None:
    """The hash of all files of a top-level package or module; None if it has none.

    All of them, since a metric may depend on any: its code, weights, or a table of thresholds.
    """
    spec = importlib.util.find_spec(name) if name != "__main__" else None
    if spec is None or not spec.origin:
        return None
    origin = Path(spec.origin)
    files = [origin]
    if spec.submodule_search_locations:
        files = sorted(f for f in origin.parent.rglob("*") if f.is_file() and CACHE not in f.parts)
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.relative_to(origin.parent)}\0".encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _read(file: Path | None) -> list[ClipResult]:
    """The rows that are kept; none if there are none, or if the file is damaged."""
    try:
        return read_rows(file) if file else []
    except (DataError, FileNotFoundError):
        return []
