"""Imports recordings as a data folder: looks at all, decodes the sound ones, fills shards."""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from acwm_core.data.card import CARD, DatasetCard, other_dataset, package_versions
from acwm_core.data.generate import fill
from acwm_core.env.card import plain_rate
from acwm_core.env.episode import SPLITS, Split
from acwm_core.errors import DataError
from acwm_core.executors import LocalExecutor, progress_bar
from acwm_core.files import held, plain_name, writing, written_whole
from acwm_formats.action_rates import Parts, action_rate
from acwm_formats.alignment import Defect
from acwm_formats.cadence import QUARTER, SAME, common_rate
from acwm_formats.import_cards import Described, few
from acwm_formats.reading import (
    CommonReading,
    ImportOptions,
    Scan,
    ScanTask,
    common_reading,
    divided,
    episode_name,
    opened,
    scan,
    stated_rates,
)
from acwm_formats.staging import ORDER, STAGING, Staged, StagedEpisodes, StageTask, stage
from acwm_formats.timeline import RecordedDataset, Recordings, TimedRecording

ROWS = 1_000_000  # approximate number of rows of actions that determine the bounds
AT_ONCE = 64  # recordings that one task looks at
MOST_TOGETHER = 16  # recordings that one task decodes, if there are thousands


def import_dataset(
    recorded: RecordedDataset,
    out: str | Path,
    options: ImportOptions | None = None,
    *,
    workers: int | None = None,
    shard_episodes: int = 32,
    progress: bool = True,
) -> DatasetCard:
    """Write recordings as the data folder `out`.

    All recordings are examined and decoded before anything is refused, so that all defects are in
    one list; those that are known without decoding are reported at once, too. What was decoded is
    kept, so the same call goes on where a killed one ended, and so does one with other options or
    after a file was removed.

    Args:
        recorded: what a format read, e.g. ``LeRobot().read(root)``.
        options: what a user decides about it.
        workers: number of processes, one per core by default; 0 imports in this process.

    Returns:
        The card of the folder.

    Raises:
        DataError: recordings have defects and `options` do not say what to do about them; the
            folder holds another dataset or is in use; the name of the environment is no plain word.
        ShapeError: the frame size is not possible.
    """
    options = options or ImportOptions()
    try:
        plain_name(options.environment or recorded.name, "an environment")
    except ValueError as error:
        raise DataError(str(error)) from None
    parts = divided(recorded, options.test_episodes)
    if not parts:
        raise DataError(f"{recorded.facts['name']} holds no recordings")
    first = _first(recorded, parts, options.cameras)
    if not options.alignment.kinds:
        kinds = recorded.actions.kinds(np.shape(first.actions.values)[-1])
        options = replace(options, alignment=replace(options.alignment, kinds=kinds))
    job = _Import(
        recorded,
        Path(out),
        options,
        parts,
        first,
        common_reading(recorded, first, options),
        LocalExecutor(workers),
        progress,
    )
    return job.run(shard_episodes)


@dataclass(frozen=True)
class _Import:
    """One import: what is requested, and the steps.

    Attributes:
        parts: the recordings of each split, and the places in them of those that belong to it.
        first: a recording that can be opened.
        reading: what all have in common with it.
    """

    recorded: RecordedDataset
    out: Path
    options: ImportOptions
    parts: Parts
    first: TimedRecording
    reading: CommonReading
    executor: LocalExecutor
    progress: bool

    @property
    def described(self) -> Described:
        """What is written about it."""
        return Described(self.recorded, self.options, self.reading, tuple(self.first.cameras))

    def run(self, shard_episodes: int) -> DatasetCard:
        """Look, decode, and fill the folder."""
        scans = [] if self.recorded.costly else self._scan()
        fps = self._rate(scans)
        self._ask_kind(scans)
        own = {(scan.split, scan.index): [*scan.defects] for scan in scans if scan.defects}
        rates = {(scan.split, scan.index): self._of_another_rate(scan, fps) for scan in scans}
        bad = {key: own.get(key, []) + rates[key] for key in {**own, **rates}}
        if self.progress:
            self._report([defect for defects in bad.values() for defect in defects])
        plan = self._plan(scans, fps)
        staging = self.out / STAGING
        if not staging.exists() and (self.out / CARD).exists():
            return self._existing(plan)
        with writing(self.out):
            if self.out.exists():
                _refuse_other_files(self.out)
            staging.mkdir(parents=True, exist_ok=True)
        with held(staging, self.out):
            staged = self._decode(fps, {key for key, defects in bad.items() if defects})
            kept, skipped = self._usable(bad, staged)
            scans = [recording.scan for recording in kept]
            again = not self.recorded.costly
            rate = action_rate(kept, self.parts, self.reading, staging, again=again)
            card = self.described.card(fps, plan, shard_episodes, scans, skipped, rate)
            filled = self._fill(card, kept)
        shutil.rmtree(staging, ignore_errors=True)
        return filled

    def _ask_kind(self, scans: Sequence[Scan]) -> None:
        """Ask what actions command, if holding them would likely be wrong."""
        facts, kinds = self.recorded.actions, self.options.alignment.kinds
        if facts.ask and not kinds and any(scan.unused for scan in scans):
            most = max(scan.per_frame for scan in scans)
            raise DataError(
                f"actions come {most:.3g} times per frame, and the files do not say what they "
                "command: give --action-kind absolute, velocity, torque or delta"
            )

    def _report(self, defects: Sequence[Defect]) -> None:
        """Print defects as soon as they are known, since decoding may take hours."""
        if defects:
            end = {
                "refuse": "the others are decoded to check them, and kept for the next import",
                "skip": "these recordings are left out",
                "trim": "their usable parts are kept",
            }[self.options.alignment.on_defect]
            lines = "\n".join(f"  {line}" for line in few([*map(str, defects)]))
            print(f"found without decoding ({end}):\n{lines}", file=sys.stderr, flush=True)

    def _scan(self) -> list[Scan]:
        total = sum(len(places) for _, places in self.parts.values())
        tasks = [
            ScanTask(
                _subset(recordings, places[start : start + AT_ONCE]),
                split,
                tuple(places[start : start + AT_ONCE]),
                self.reading,
                max(64, ROWS // total),
            )
            for split, (recordings, places) in self.parts.items()
            for start in range(0, len(places), AT_ONCE)
        ]
        executor = self.executor if total > AT_ONCE else LocalExecutor(0)  # workers start slowly
        is_slow = self.progress and total > AT_ONCE
        with progress_bar("looking", total, shown=is_slow) as report:
            scans = [*itertools.chain.from_iterable(executor.run(scan, tasks, report))]
        return sorted(scans, key=lambda scan: (SPLITS.index(scan.split), scan.index))

    def _rate(self, scans: Sequence[Scan]) -> float:
        """Frames per second of the dataset."""
        if (fps := self.options.alignment.fps) is not None:
            return plain_rate(fps)
        measured = [(scan.rate, scan.seconds) for scan in scans]
        stated = stated_rates(self.recorded, self.first)
        rate = common_rate(measured, stated) or next(iter(stated), None)
        if rate is None:
            raise DataError("the recordings do not state their frame rate: give --fps")
        return plain_rate(rate)

    def _of_another_rate(self, scan: Scan, fps: float) -> list[Defect]:
        if self.options.alignment.fps is not None or not scan.rate:
            return []
        error = abs(scan.rate / fps - 1)
        if error <= SAME + QUARTER / max(1.0, scan.seconds * scan.rate):
            return []
        rates = f"{scan.rate:.4g} frames/s, and the others {fps:.4g}"
        return [Defect(scan.name, f"it has {rates}", "--fps")]

    def _plan(self, scans: Sequence[Scan], fps: float) -> str:
        """What identifies the dataset to be, but for the pixels of its files."""
        about = [self.recorded.facts, repr(self.options), fps, [scan.keys for scan in scans]]
        return hashlib.sha256(json.dumps(about, default=repr).encode()).hexdigest()

    def _existing(self, plan: str) -> DatasetCard:
        """The card of a folder that is whole, if it is what this import would make."""
        card = DatasetCard.read(self.out)
        if card.source.get("plan") == plan and set(card.checksums) == set(card.splits):
            return card
        source = {**card.source, **self.recorded.facts, **self.described.command()}
        differences = card.differences(replace(card, source=source))
        raise other_dataset(self.out, differences or ["its recordings have changed"])

    def _decode(self, fps: float, bad: set[tuple[str, int]]) -> list[Staged]:
        versions = package_versions()
        tasks = [
            StageTask(
                _subset(recordings, part),
                split,
                part,
                self.reading,
                fps,
                versions,
                (self.out / STAGING).absolute(),
                ROWS // len(places) + 1,
            )
            for split, (recordings, places) in self.parts.items()
            for part in self._together(split, places, bad)
        ]
        total = sum(len(task.indices) for task in tasks)
        with progress_bar(self.recorded.name, total, shown=self.progress) as report:
            staged = [*itertools.chain.from_iterable(self.executor.run(stage, tasks, report))]
        keys = [(task.split, index) for task in tasks for index in task.indices]
        order = dict(zip(keys, range(total), strict=True))
        return sorted(staged, key=lambda one: order[one.scan.split, one.scan.index])

    def _together(
        self, split: Split, places: Sequence[int], bad: set[tuple[str, int]]
    ) -> Iterator[tuple[int, ...]]:
        """The recordings to decode, in parts that one task opens."""
        indices = [
            index
            for index in places
            if (split, index) not in bad or self.options.alignment.on_defect == "trim"
        ]
        together = max(self.recorded.together, min(MOST_TOGETHER, len(places) // 256))
        for _, part in itertools.groupby(indices, lambda index: index // together):
            yield tuple(part)

    def _usable(
        self, bad: Mapping[tuple[str, int], list[Defect]], staged: Sequence[Staged]
    ) -> tuple[list[Staged], list[str]]:
        """The recordings to keep, and why the others are left out.

        Raises:
            DataError: some have defects and are not to be left out, or all have.
        """
        defects = {key: list(known) for key, known in bad.items()}
        by_key = {(recording.scan.split, recording.scan.index): recording for recording in staged}
        for key, recording in by_key.items():
            known = defects.setdefault(key, [])
            known += [defect for defect in recording.scan.defects if defect not in known]
        messages = [str(defect) for known in defects.values() for defect in known]
        decision = self.options.alignment.on_defect
        kept = {
            key: recording
            for key, recording in by_key.items()
            if (recording.files if decision == "trim" else not defects[key])
        }
        if messages and (decision == "refuse" or not kept):
            count = sum(len(places) for _, places in self.parts.values())
            wrong = sum(1 for known in defects.values() if known)
            choice = "; --on-defect skip imports the others" if kept else ""
            listed = ";\n".join(f"  {line}" for line in few(messages))
            have = "has" if wrong == 1 else "have"
            raise DataError(f"{wrong} of {count} recordings {have} defects{choice}:\n{listed}")
        skipped = [str(d) for key, known in defects.items() if key not in kept for d in known]
        return [*kept.values()], skipped

    def _fill(self, card: DatasetCard, kept: Sequence[Staged]) -> DatasetCard:
        """Fill the shards with the staged episodes."""
        staging = self.out / STAGING
        files = {s: [f for k in kept if k.scan.split == s for f in k.files] for s in card.splits}
        with writing(self.out):
            with written_whole(staging / ORDER) as partial:
                partial.write_text(json.dumps(files), encoding="utf-8")
            if (self.out / CARD).exists() and DatasetCard.read(self.out).differences(card):
                (self.out / CARD).unlink()  # a killed import left it, with other options or files
                for split in SPLITS:
                    shutil.rmtree(self.out / split, ignore_errors=True)
        source = StagedEpisodes(staging.absolute(), card.environment.action, card.versions)
        return fill(self.out, card, source, LocalExecutor(0), progress=False)


def _first(recorded: RecordedDataset, parts: Parts, chosen: Sequence[str] = ()) -> TimedRecording:
    """The first recording that can be opened."""
    problem = None
    for split, (recordings, places) in parts.items():
        for index in places:
            try:
                recording = opened(recordings, index, episode_name(split, index), recorded.fps)
                cameras = [name for name in chosen if name in recording.cameras]
                cameras = cameras or recording.cameras
                if not cameras or any(recording.cameras[name].size for name in cameras):
                    return recording
            except (DataError, OSError) as error:
                problem = problem or DataError(f"{episode_name(split, index)}: {error}")
                if recorded.costly:
                    raise problem from error
    raise problem or DataError("there are no recordings")


def _subset(recordings: Recordings, places: Sequence[int]) -> Recordings:
    """What a worker gets: of a list only the recordings that it needs."""
    if isinstance(recordings, list | tuple):
        return cast(Recordings, {index: cast(Any, recordings)[index] for index in places})
    part = getattr(recordings, "part", None)
    return part(places) if part else recordings


def _refuse_other_files(out: Path) -> None:
    names = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    if names and not (out / STAGING).exists():
        raise DataError(
            f"{out} holds other files ({names[0]}) and no dataset: choose another --out"
        )
