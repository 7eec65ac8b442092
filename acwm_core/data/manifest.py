"""The manifest of a split: one JSON line per finished shard, which says what the shard holds."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.atomic import written_whole
from acwm_core.data.card import are_numbers
from acwm_core.data.shards import open_shard
from acwm_core.errors import DataError
from acwm_core.untrusted import parse_json, read_bytes, typed

MANIFEST = "manifest.jsonl"
MAX_BYTES, MAX_FRAMES = 2**28, 2**27
"""Limits: bytes of a manifest, and frames of a split (two million episodes of the usual length)."""

SHARD = re.compile(r"shard-\d{5,9}\.tar")


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file, in hex digits.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error


def shard_name(number: int) -> str:
    """File name of shard `number`."""
    return f"shard-{number:05d}.tar"


@dataclass(frozen=True)
class ActionSums:
    """Sums over a shard's actions, which add up across shards; one value per action dimension.

    The last row of an episode's actions is zero and no action; it is not counted.
    """

    count: int
    total: list[float]
    squares: list[float]
    low: list[float]
    high: list[float]

    def __post_init__(self) -> None:
        """Raise a `ValueError` for values that cannot be sums of actions."""
        rows = self.total, self.squares, self.low, self.high
        if not are_numbers([[self.count]]) or self.count < 0 or not are_numbers(rows):
            raise ValueError("the sums of its actions are not finite numbers")

    @classmethod
    def of(cls, actions: NDArray[np.float32]) -> ActionSums:
        """The sums over rows `[N, A]`, in float64."""
        rows = actions.astype(np.float64)
        sums = rows.sum(0), (rows**2).sum(0), rows.min(0), rows.max(0)
        return cls(len(rows), *(each.tolist() for each in sums))


@dataclass(frozen=True)
class ShardRecord:
    """One finished shard."""

    shard: str  # file name
    first: int  # index of its first episode in the split
    lengths: tuple[int, ...]  # number of frames of each of its episodes
    size: int  # bytes of the file
    sha256: str  # checksum of the file
    actions: ActionSums  # sums over its actions

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    @property
    def frames(self) -> int:
        """Number of frames of all its episodes together."""
        return sum(self.lengths)

    @classmethod
    def of_file(cls, path: Path, first: int) -> ShardRecord:
        """Describe the finished shard at `path` by reading it.

        Raises:
            DataError: it is missing or damaged.
        """
        reader = open_shard(path)
        actions = [reader.array(position, "actions.npy") for position in range(len(reader))]
        return cls(
            path.name,
            first,
            tuple(len(rows) for rows in actions),
            path.stat().st_size,
            file_sha256(path),
            ActionSums.of(np.concatenate([rows[:-1] for rows in actions])),
        )

    def to_json(self) -> str:
        """One JSON line; `episodes` and `frames` are only for people who read the file."""
        fields = asdict(self) | {"episodes": self.episodes, "frames": self.frames}
        return json.dumps(fields, sort_keys=True)

    @classmethod
    def from_json(cls, line: str) -> ShardRecord:
        """Read what `to_json` wrote.

        Raises:
            ValueError: it is not a valid record, e.g. its shard lies in another folder.
        """
        record = typed(parse_json(line), cls)
        if not SHARD.fullmatch(record.shard):
            raise ValueError(f"{record.shard!r} is not the name of a shard")
        if not record.lengths or min(record.first, record.size, *record.lengths) < 0:
            raise ValueError(f"{record.shard} has impossible counts")
        return record


class Manifest:
    """The records of one split's folder, by shard name.

    Lines are appended as shards finish, so a killed command loses none; `finish` sorts them.

    Args:
        folder: the folder of the split.
        episodes: number of episodes according to the card. Shards beyond it come from a killed
            command that was adding them, and are left out. By default all are read.

    Raises:
        DataError: the file is not a manifest.
    """

    def __init__(self, folder: Path, episodes: int | None = None) -> None:
        self.path = folder / MANIFEST
        self.records: dict[str, ShardRecord] = {}
        text = read_bytes(self.path, MAX_BYTES) if self.path.exists() else b""
        lines = text.decode("utf-8", errors="replace").split("\n")  # damaged bytes fail below
        for line in lines[:-1]:
            try:
                record = ShardRecord.from_json(line)
            except ValueError as error:
                raise self._damaged(str(error)) from error
            if episodes is None or record.first < episodes:
                self.records[record.shard] = record
        if (frames := sum(record.frames for record in self.records.values())) > MAX_FRAMES:
            raise self._damaged(f"{frames} frames are more than {MAX_FRAMES}")
        self._torn = bool(lines[-1])  # its writer was killed, or is still writing

    def _damaged(self, why: str) -> DataError:
        return DataError(
            f"{self.path} is damaged ({why}): delete it and run the same command, which describes "
            "the finished shards again"
        )

    def add(self, record: ShardRecord) -> None:
        """Record a finished shard; the line is on disk when this returns."""
        if self._torn:
            self.finish()
        self.records[record.shard] = record
        with self.path.open("a") as file:
            file.write(record.to_json() + "\n")
            file.flush()
            os.fsync(file.fileno())

    def finish(self) -> None:
        """Rewrite the file with its records in order, so equal datasets have equal manifests."""
        with written_whole(self.path) as partial:
            lines = "".join(f"{record.to_json()}\n" for record in self.ordered())
            partial.write_text(lines, encoding="utf-8")
        self._torn = False

    def ordered(self) -> list[ShardRecord]:
        """The records, sorted by shard number."""
        return [self.records[name] for name in sorted(self.records)]

    def has(self, name: str) -> bool:
        """Whether shard `name` is recorded and its file exists with the recorded size."""
        path = self.path.parent / name
        record = self.records.get(name)
        return record is not None and path.exists() and path.stat().st_size == record.size

    def checksum(self) -> str:
        """SHA-256 of all shards' checksums, in 64 hex digits; it identifies the split's content."""
        digests = "\n".join(record.sha256 for record in self.ordered())
        return hashlib.sha256(digests.encode()).hexdigest()


def action_statistics(records: Sequence[ShardRecord]) -> dict[str, list[float]]:
    """Mean, standard deviation, minimum and maximum of every action dimension."""

    def stacked(name: str) -> NDArray[np.float64]:
        return np.array([getattr(record.actions, name) for record in records], np.float64)

    count = sum(record.actions.count for record in records)
    mean = stacked("total").sum(0) / count
    squares = stacked("squares").sum(0) / count
    return {
        "mean": mean.tolist(),
        "std": np.sqrt(np.maximum(squares - mean**2, 0)).tolist(),
        "min": stacked("low").min(0).tolist(),
        "max": stacked("high").max(0).tolist(),
    }
