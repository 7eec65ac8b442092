"""Simulating episodes again, with other actions or starts, once for all models compared."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.shards import open_shard, write_shard
from acwm_core.data.simulate import simulate
from acwm_core.env.environment import Environment
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.errors import DataError
from acwm_core.evaluation.references import cached, installed_packages, package_hash


class Again(NamedTuple):
    """What is simulated again; see `simulate`."""

    spec: EpisodeSpec
    actions: NDArray[np.float32]
    frames: int
    perturbation: float = 0.0
    start: int = 0

    def facts(self) -> dict[str, Any]:
        """All of it, for JSON."""
        actions = hashlib.sha256(self.actions[: self.frames - 1].tobytes()).hexdigest()
        return {**self._asdict(), "spec": self.spec.to_dict(), "actions": actions}


def simulate_again(environment: Environment, asked: Sequence[Again]) -> list[Episode]:
    """Simulate what is asked, or read what an earlier evaluation simulated.

    It is kept in the user's cache of references, if that can be written, as one shard per call. A
    shard that another version of the simulator made is replaced.

    Args:
        environment: what simulates.
        asked: the episodes that are wanted.
    """
    key = hashlib.sha256(json.dumps([each.facts() for each in asked]).encode()).hexdigest()
    file = cached(f"simulated-{key[:16]}.tar")
    made_by = _versions(environment)
    with contextlib.suppress(DataError, OSError):  # not there yet, damaged, or of another version
        return _read(file, asked, made_by)
    made = [
        simulate(environment, spec, actions, frames=frames, perturbation=moved, start=start)
        for spec, actions, frames, moved, start in asked
    ]
    if None not in made_by.values():
        with contextlib.suppress(OSError):  # e.g. a read-only cache
            file.parent.mkdir(parents=True, exist_ok=True)
            _write(file, made, environment.card.fps, made_by)
    return made


def _versions(environment: Environment) -> dict[str, Any]:
    """Everything that decides what the simulator makes of a spec; None for what has no hash."""
    packages = {base.__module__.partition(".")[0] for base in type(environment).__mro__[:-1]}
    code = {name: package_hash(name) for name in sorted(packages - {"abc", "typing"})}
    installed = json.dumps(installed_packages())
    return {**code, "installed": hashlib.sha256(installed.encode()).hexdigest()}


def _read(file: Path, asked: Sequence[Again], made_by: Mapping[str, Any]) -> list[Episode]:
    reader = open_shard(file)
    if reader.about(0)["versions"] != made_by:
        raise DataError(f"{file} is of another version")
    return [replace(reader.episode(k), spec=each.spec) for k, each in enumerate(asked)]


def _write(file: Path, made: Sequence[Episode], fps: float, made_by: Mapping[str, Any]) -> None:
    numbered = (replace(each, spec=replace(each.spec, index=k)) for k, each in enumerate(made))
    write_shard(file, numbered, fps, made_by)
