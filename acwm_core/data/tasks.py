"""Making one shard: the unit of work of `generate`, on whatever executor.

A shard is a pure function of its task: which worker makes it, when and beside what changes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acwm_core.data.manifest import ShardRecord
from acwm_core.data.shards import open_shard, write_shard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.environment import Environment
from acwm_core.episode import Episode, EpisodeSpec, FactorSetting, Split
from acwm_core.errors import AcwmError, DataError
from acwm_core.executors import Report
from acwm_core.registry import Component


@dataclass(frozen=True)
class ShardTask:
    """One shard to make.

    Attributes:
        path: the tar file.
        component: the environment's catalog entry, so that a worker needs no catalog of its own.
        split: its split.
        first: index in the split of the first episode.
        episodes: how many.
        seed: seed of the dataset.
        factors: factor settings that override the split's.
        options: constructor options of the environment.
        versions: recorded with every episode.
    """

    path: Path
    component: Component
    split: Split
    first: int
    episodes: int
    seed: int
    factors: Mapping[str, FactorSetting] = field(default_factory=dict[str, FactorSetting])
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    versions: Mapping[str, str] = field(default_factory=dict[str, str])

    def specs(self) -> list[EpisodeSpec]:
        """The specs of its episodes."""
        return [
            EpisodeSpec(
                self.component.name, self.split, index, self.seed, self.factors, self.options
            )
            for index in range(self.first, self.first + self.episodes)
        ]


def make_shard(task: ShardTask, report: Report) -> tuple[Split, ShardRecord]:
    """Simulate the episodes of `task` and write its shard; reports every episode.

    A complete shard that is there already, made by a command that was killed before it could
    record it, is described and not made again.

    Returns:
        The split and what its manifest is to say of the shard.

    Raises:
        DataError: an episode could not be simulated, or the shard not be written.
        RuntimeError: the environment raised something else; the message names the episode.
    """
    record = existing_shard(task.path, task.specs())
    if record is not None:
        report(record.episodes)
        return task.split, record
    environment = _environment(task)
    episodes = _simulated(environment, task, report)
    fps = environment.card.fps
    return task.split, store_shard(task.path, task.first, episodes, fps, task.versions)


def existing_shard(path: Path, specs: Sequence[EpisodeSpec]) -> ShardRecord | None:
    """Describe the shard at `path` if it is there whole and holds the episodes of `specs`."""
    if not path.exists():
        return None
    try:
        reader = open_shard(path)
        made = [reader.about(position)["spec"] for position in range(len(reader))]
        if made != json.loads(json.dumps([spec.to_dict() for spec in specs])):
            return None
        return ShardRecord.of_file(path, specs[0].index)
    except DataError:
        return None


def store_shard(
    path: Path, first: int, episodes: Iterable[Episode], fps: int, versions: Mapping[str, str]
) -> ShardRecord:
    """Write `episodes`, of which the first has the index `first`, and describe their shard.

    Raises:
        DataError: it could not be written.
    """
    try:
        write_shard(path, episodes, fps, versions)
    except OSError as error:
        raise DataError(
            f"cannot write {path} ({error.strerror}): make room or allow it, and run the "
            "same command again to go on"
        ) from error
    return ShardRecord.of_file(path, first)


def _simulated(environment: Environment, task: ShardTask, report: Report) -> Iterator[Episode]:
    for spec in task.specs():
        what = f"episode {spec.index} of {spec.split} of {spec.environment}"
        try:
            episode = simulate(environment, spec)
        except AcwmError as error:
            raise DataError(f"{what} could not be simulated: {error} (spec {spec})") from error
        except Exception as error:
            raise RuntimeError(
                f"{what} could not be simulated: {type(error).__name__}: {error} (spec {spec})"
            ) from error
        yield episode
        report(1)


def _environment(task: ShardTask) -> Environment:
    """This process's environment for `task`: scenes and compiled kernels are costly to make."""
    component = task.component
    key = json.dumps([component.target, dict(component.defaults), dict(task.options)], default=repr)
    if key not in _environments:
        for environment in _environments.values():
            environment.close()
        _environments.clear()
        _environments[key] = make_environment(component, task.options)
    return _environments[key]


_environments: dict[str, Environment] = {}
