"""A dataset: the manifest of each split, and random access to its episodes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.arrays import from_npz
from acwm_core.data.card import MANIFEST, DatasetCard
from acwm_core.data.remote import data_folder, fetch_shard, origin
from acwm_core.data.shards import MEMBERS, ShardReader, ShardRecord, open_shard
from acwm_core.data.video import decode_into, decode_planes
from acwm_core.env.episode import Episode, Split
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import DataError
from acwm_core.files import check_fetched, written_whole


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
        text = self.path.read_bytes() if self.path.exists() else b""
        lines = text.decode("utf-8", errors="replace").split("\n")  # damaged bytes fail below
        for line in lines[:-1]:
            try:
                record = ShardRecord.from_json(line)
            except ValueError as error:
                check_fetched(self.path)
                raise DataError(
                    f"{self.path} is damaged ({error}): delete it and run the same command, which "
                    "describes the finished shards again"
                ) from error
            if episodes is None or record.first < episodes:
                self.records[record.shard] = record
        self._torn = bool(lines[-1])  # its writer was killed, or is still writing

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


class EpisodeDataset:
    """A sequence of `Episode`s. It keeps no file open and can be sent to other processes.

    Args:
        path: the data folder, or its URL. Shards behind a URL are fetched on first use and kept in
            a cache (see `acwm_core.data.remote`).
        split: which of its splits.
        growing: use the episodes that are finished, while others are still being made.

    Attributes:
        path: the local data folder; for a URL, its folder in the cache.
        card: the folder's card.
        lengths: number of frames of every episode.
        checksum: hash of everything the split holds; for growing data, of its card.
        shards: for each shard, the index of its first episode and its number of episodes.

    Raises:
        DataError: no such folder or split, or its generation was not finished.
        DataError: growing data has no finished episode, or was not simulated here.
    """

    def __init__(self, path: str | Path, split: Split, *, growing: bool = False) -> None:
        self.path, self.split = data_folder(path), split
        self.card = DatasetCard.read(self.path)
        if split not in self.card.splits:
            known = ", ".join(self.card.splits)
            made_here = not self.card.source and origin(self.path) is None
            add = f": add it with `{self.card.command(path, split)}`" if made_here else ""
            raise DataError(f"{path} has no split {split!r}, only {known}{add}")
        wanted = self.card.splits[split]
        manifest = Manifest(self.path / split, wanted)
        records = _finished(path, self.card, manifest) if growing else manifest.ordered()
        self.lengths = [length for record in records for length in record.lengths]
        if len(self.lengths) != wanted and not growing:
            raise DataError(
                f"{split} of {path} holds {len(self.lengths)} of its {wanted} episodes: run the "
                "command that made it again to add the others, or train while it "
                "runs with data.growing=true"
            )
        self.checksum = self.card.identity if growing else manifest.checksum()
        self.shards = [(record.first, record.episodes) for record in records]
        self._records, self._origin = records, origin(self.path)

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, index: int) -> Episode:
        """Read one episode with everything that was recorded of it.

        Raises:
            IndexError: there is no such episode.
            DataError: its shard is missing or damaged.
        """
        reader, position = self._locate(index)
        return reader.episode(position, self.card.environment.frame_size)

    def __iter__(self) -> Iterator[Episode]:
        return (self[index] for index in range(len(self)))

    def video(self, index: int, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
        """Frames `start` to `stop` of an episode, ``[T, 3, H, W]`` uint8."""
        reader, position = self._locate(index)
        size, length = self.card.environment.frame_size, self.lengths[index]
        decode = functools.partial(decode_planes, start=start, stop=stop, size=size, length=length)
        return reader.decoded(position, "video.mkv", decode)

    def video_into(self, target: NDArray[np.uint8], index: int, start: int) -> None:
        """Decode frames of an episode, from frame `start` on, into `target` ``[T, 3, H, W]`` uint8.

        After the end of the episode its last frame is repeated.
        """
        reader, position = self._locate(index)
        length = self.lengths[index]
        reader.decoded(position, "video.mkv", lambda data: window_into(target, data, start, length))

    def actions(self, index: int) -> NDArray[np.float32]:
        """The raw actions of an episode, ``[T, A]``."""
        reader, position = self._locate(index)
        return reader.array(position, "actions.npy")

    def states(self, index: int, names: Sequence[str]) -> NDArray[np.float32]:
        """The values of some fields of the state of an episode, side by side, ``[T, S]``.

        Raises:
            DataError: the episode lacks one of them.
        """
        reader, position = self._locate(index)
        fields = reader.decoded(position, "states.npz", from_npz)
        missing = [name for name in names if name not in fields]
        if missing:
            raise DataError(f"episode {index} of {self.split} of {self.path} has no {missing[0]}")
        rows = [fields[name].reshape(self.lengths[index], -1) for name in names]
        return np.concatenate(rows, 1, dtype=np.float32, casting="unsafe")

    def damage(self, index: int) -> str | None:
        """Why an episode cannot be read, if it cannot; all its bytes are checked."""
        try:
            reader, position = self._locate(index)
            for name in MEMBERS:
                reader.read(position, name)
        except DataError as error:
            return str(error)
        return None

    def about(self, index: int) -> dict[str, Any]:
        """Spec, factors, ood_label and versions of an episode, without decoding its video."""
        reader, position = self._locate(index)
        return reader.about(position)

    def shard_of(self, index: int) -> int:
        """The number of the shard that holds an episode."""
        return bisect_right(self.shards, (index, len(self))) - 1

    def shard_path(self, number: int) -> Path:
        """The path of shard `number`."""
        return self.path / self.split / self._records[number].shard

    @contextlib.contextmanager
    def passing_shard(self, number: int) -> Generator[ShardReader]:
        """Open shard `number` for a while. If it must be fetched, it is not added to the cache.

        Raises:
            DataError: it is missing or damaged, or cannot be fetched.
        """
        path = self.shard_path(number)
        if self._origin is None or path.exists():
            yield open_shard(path)
            return
        with tempfile.TemporaryDirectory(prefix="acwm-") as folder:
            yield open_shard(self._fetched(number, Path(folder, path.name)))

    def _locate(self, index: int) -> tuple[ShardReader, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        index %= len(self)
        number = self.shard_of(index)
        path = self._fetched(number, self.shard_path(number))
        return open_shard(path), index - self.shards[number][0]

    def _fetched(self, number: int, path: Path) -> Path:
        if self._origin and not path.exists():
            record = self._records[number]
            fetch_shard(f"{self._origin}/{self.split}/{record.shard}", path, record.sha256)
        return path


def _finished(path: str | Path, card: DatasetCard, manifest: Manifest) -> list[ShardRecord]:
    """The shards up to the first that is not finished; workers do not finish them in order."""
    if card.source or origin(data_folder(path)):
        raise DataError(
            f"{path} cannot grow: data.growing is for a folder that `acwm generate` fills"
        )
    records, episodes = list[ShardRecord](), 0
    for record in manifest.ordered():
        if record.first == episodes:
            records.append(record)
            episodes += record.episodes
    if not records:
        raise DataError(f"no shard of {path} is finished yet: start again once one is")
    return records


def declared_symmetries(episodes: EpisodeDataset) -> tuple[Symmetry, ...]:
    """The symmetries on the card of a dataset.

    Raises:
        DataError: there are none.
    """
    card = episodes.card.environment
    if not card.symmetries:
        raise DataError(
            f"the card of {episodes.path} declares no symmetries of {card.name}: train without "
            "data.symmetries; if its environment declares some now, run the command that made the "
            "data again, which adds them to the card"
        )
    return card.symmetries


def window_into(target: NDArray[np.uint8], data: bytes, start: int, length: int) -> None:
    """Decode a window of an episode's video, from frame `start` on, into `target` ``[T, 3, H, W]``.

    After the end of the episode, which has `length` frames, its last frame is repeated.

    Raises:
        DataError: the bytes are not such a video.
    """
    held = min(len(target), length - start)
    decode_into(target[:held], data, start)
    target[held:] = target[held - 1]
