"""From recordings to a data folder like any other: resumable, by many workers, bounded memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.data.card import DatasetCard, package_versions, write_readme
from acwm_core.data.exchange.area import target_size
from acwm_core.data.exchange.recording import Recording, recorded_card, recorded_episode
from acwm_core.data.exchange.source import Recordings, Source
from acwm_core.data.executors import Report, make_executor
from acwm_core.data.generate import fill, writing
from acwm_core.data.manifest import Manifest, ShardRecord
from acwm_core.data.simulate import existing_shard, store_shard
from acwm_core.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.episode import SPLITS, Episode, EpisodeSpec, Split
from acwm_core.errors import AcwmError, DataError, suggest

SHARD_EPISODES = 32
"""Episodes per shard, as `acwm generate` makes them."""


@dataclass(frozen=True)
class ImportTask:
    """One shard to fill with recordings: as `ShardTask`, with `recordings` to read from."""

    path: Path
    split: Split
    first: int
    episodes: int
    environment: EnvironmentCard
    recordings: Recordings
    seed: int
    options: Mapping[str, Any]
    versions: Mapping[str, str]

    def specs(self) -> list[EpisodeSpec]:
        """The specs of its episodes."""
        name, options = self.environment.name, self.options
        return [
            EpisodeSpec(name, self.split, index, self.seed, {}, options)
            for index in range(self.first, self.first + self.episodes)
        ]


def import_dataset(
    source: Source,
    out: str | Path,
    *,
    workers: int | None = None,
    shard_episodes: int = SHARD_EPISODES,
    progress: bool = True,
) -> DatasetCard:
    """Write the recordings of `source` as the data folder `out`.

    Finished shards are kept, so the same call goes on where a killed one ended. One recording per
    worker is in memory at a time.

    Args:
        source: from an importer, e.g. `lerobot_source`.
        out: the folder; created with its parents.
        workers: processes, one per core by default; 0 imports in this process.
        shard_episodes: episodes per shard.
        progress: show a progress bar on the terminal.

    Returns:
        The card of the folder.

    Raises:
        DataError: a recording cannot be read or is not what the source says; the folder holds
            another dataset or is in use.
    """
    out, card = Path(out), source.environment
    splits: dict[Split, int] = {
        split: len(source.splits[split])
        for split in SPLITS
        if split in source.splits and len(source.splits[split])
    }
    wanted = DatasetCard(
        environment=card,
        splits=splits,
        seed=source.seed,
        options={"size": list(card.frame_size)},
        factors={},
        shard_episodes=shard_episodes,
        versions=package_versions(),
        source=dict(source.facts),
    )
    if not wanted.splits:
        raise DataError(f"{source.facts['name']} holds no recordings")

    def task(path: Path, split: Split, first: int, count: int) -> ImportTask:
        recordings = source.splits[split]
        options, versions = wanted.options, wanted.versions
        return ImportTask(
            path, split, first, count, card, recordings, source.seed, options, versions
        )

    made = fill(out, wanted, task, import_shard, make_executor(workers), progress=progress)
    made = replace(made, source={**made.source, "notes": [*source.notes, *_shorter(source, out)]})
    with writing(out):
        made.write(out)
        write_readme(out, made)
    return made


def import_shard(task: ImportTask, report: Report) -> tuple[Split, ShardRecord]:
    """Read the recordings of `task` and write its shard; reports every episode.

    Raises:
        DataError: a recording is not what the task says, or the shard could not be written.
    """
    record = existing_shard(task.path, task.specs())
    if record is not None:
        report(record.episodes)
        return task.split, record
    episodes, fps = _episodes(task, report), task.environment.fps
    return task.split, store_shard(task.path, task.first, episodes, fps, task.versions)


def write_dataset(
    out: str | Path,
    splits: Mapping[Split, Recordings],
    *,
    name: str,
    action: ActionSpec,
    fps: int,
    state: Mapping[str, str] | None = None,
    size: int | tuple[int, int] | None = None,
    summary: str = "",
    workers: int = 0,
    progress: bool = True,
) -> DatasetCard:
    """Write recordings of your own as a data folder, on which everything else works.

    Args:
        out: the folder; created with its parents.
        splits: per split its recordings: a list of `Recording`, or an object with ``__len__`` and
            ``__getitem__`` that reads one when it is asked.
        name: of what they show, one word.
        action: names, units and bounds of the action.
        fps: frames, and so actions, per second.
        state: unit of each array in `Recording.states`, by name; none by default.
        size: frame size, a side or ``(H, W)``; larger frames are averaged down. By default that
            of the first recording, each side rounded down to a multiple of 8.
        summary: one sentence.
        workers: processes to read and encode in, to which `splits` must be picklable.
        progress: show a progress bar on the terminal.

    Returns:
        The card of the folder.

    Raises:
        DataError: a recording is not as it should be; the folder holds another dataset.
    """
    for split in splits:
        if split not in SPLITS:
            raise DataError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    ends = {s: (splits[s][0], splits[s][len(splits[s]) - 1]) for s in splits if len(splits[s])}
    if not ends:
        raise DataError("there are no recordings to write")
    first = next(iter(ends.values()))[0]
    card = recorded_card(
        name,
        action,
        frame_size=target_size((first.video.shape[1], first.video.shape[2]), size),
        fps=fps,
        horizon=max(recording.frames for pair in ends.values() for recording in pair),
        state=[_field(first, field, unit) for field, unit in (state or {}).items()],
        summary=summary,
    )
    sums = {split: [_digest(recording) for recording in pair] for split, pair in ends.items()}
    facts = {"kind": "python", "name": name, "sha256_of_first_and_last": sums}
    return import_dataset(Source(card, splits, facts), out, workers=workers, progress=progress)


def _episodes(task: ImportTask, report: Report) -> Iterator[Episode]:
    for spec in task.specs():
        try:
            episode = recorded_episode(task.recordings[spec.index], spec, task.environment)
        except (AcwmError, OSError) as error:
            raise DataError(f"episode {spec.index} of {spec.split}: {error}") from error
        yield episode
        report(1)


def _shorter(source: Source, out: Path) -> list[str]:
    """How many recordings have fewer frames than they are said to."""
    notes: list[str] = []
    for split, nominal in source.nominal.items():
        lengths = [n for record in Manifest(out / split).ordered() for n in record.lengths]
        short = sum(n < said for n, said in zip(lengths, nominal, strict=True))
        if short:
            notes.append(f"{split}: {short} of {len(lengths)} are shorter than they are said to be")
    return notes


def _field(recording: Recording, name: str, unit: str) -> StateField:
    if name not in recording.states:
        raise DataError(f"recordings have no state {name!r}{suggest(name, recording.states)}")
    return StateField(name, np.asarray(recording.states[name]).shape[1:], unit, "as recorded")


def _digest(recording: Recording) -> str:
    digest = hashlib.sha256()
    for array in (recording.video, recording.actions, *recording.states.values()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
