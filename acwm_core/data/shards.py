"""Shards: WebDataset tar files of whole episodes. Equal episodes give equal bytes.

`readme.md.j2` describes the members of an episode, which are stored in the order of `MEMBERS`.
A reader indexes a shard's headers once and then reads single members at their offsets, each checked
against the checksum that was written with it. Pickled objects are never loaded.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import tarfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.arrays import from_npy, from_npz, to_npy, to_npz
from acwm_core.data.video import decode_masks, decode_video, encode_masks, encode_video
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.errors import DataError
from acwm_core.files import check_fetched, parse_json, typed, written_whole

MEMBERS = ("video.mkv", "mask.mkv", "actions.npy", "states.npz", "contacts.npy", "json")
SHARD = re.compile(r"shard-\d{5,9}\.tar")

UNREADABLE = (ValueError, LookupError, TypeError, EOFError, ArithmeticError, RuntimeError)
"""Exceptions that decoding a damaged file raises."""

Decoded = TypeVar("Decoded")


def shard_name(number: int) -> str:
    """File name of shard `number`."""
    return f"shard-{number:05d}.tar"


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

    @classmethod
    def of(cls, episodes: Iterable[NDArray[np.float32]]) -> ActionSums:
        """The sums over the actions ``[T, A]`` of some episodes, in float64."""
        actions = np.concatenate([rows[:-1] for rows in episodes]).astype(np.float64)
        sums = actions.sum(0), (actions**2).sum(0), actions.min(0), actions.max(0)
        return cls(len(actions), *(total.tolist() for total in sums))


@dataclass(frozen=True)
class ShardRecord:
    """What a finished shard holds: one line of the manifest of its split."""

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
        """Describe a shard that nobody recorded, because its writer was killed, by reading it.

        Raises:
            DataError: it is missing or damaged.
        """
        reader = open_shard(path)
        actions = [reader.array(position, "actions.npy") for position in range(len(reader))]
        size, lengths = path.stat().st_size, tuple(map(len, actions))
        return cls(path.name, first, lengths, size, file_sha256(path), ActionSums.of(actions))

    def to_json(self) -> str:
        """One JSON line; `episodes` and `frames` are only for people who read the file."""
        fields = asdict(self) | {"episodes": self.episodes, "frames": self.frames}
        return json.dumps(fields, sort_keys=True)

    @classmethod
    def from_json(cls, line: str) -> ShardRecord:
        """Read what `to_json` wrote.

        Raises:
            ValueError: it is not a record, its shard lies in another folder, or claims more frames
                than it has bytes.
        """
        record = typed(parse_json(line), cls)
        if not SHARD.fullmatch(record.shard):
            raise ValueError(f"{record.shard!r} is not the name of a shard")
        if min(record.lengths, default=1) < 1 or not 0 <= record.frames <= record.size:
            raise ValueError(f"{record.shard} cannot hold episodes of {record.frames:,} frames")
        return record


class _Summed:
    """A file that is only written to, with its size and checksum."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.size, self.sha256 = file, 0, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.sha256.update(data)
        self.size += len(data)
        return self._file.write(data)


class Packed(NamedTuple):
    """An episode that is already encoded.

    Attributes:
        spec: which episode.
        actions: ``[T, A]`` float32.
        members: bytes by name, in the order of `MEMBERS`.
    """

    spec: EpisodeSpec
    actions: NDArray[np.float32]
    members: Mapping[str, bytes]


def write_shard(
    path: Path, episodes: Iterable[Episode | Packed], fps: float, versions: Mapping[str, str]
) -> ShardRecord:
    """Write `episodes` to the tar file `path`, which appears only once it is complete.

    Args:
        path: final name; its folder must exist.
        episodes: successive ones, taken one at a time, so a lazy iterable needs memory for only
            one.

    Returns:
        The record of the shard, for the manifest of its split.
    """
    from webdataset.writer import TarWriter  # pyright: ignore  (imports torch)

    actions, first = list[NDArray[np.float32]](), 0
    with written_whole(path) as partial, partial.open("wb") as opened:
        file = _Summed(opened)
        with TarWriter(
            cast(Any, file), encoder=False, user="", group="", mode=0o644, mtime=0
        ) as tar:
            for given in episodes:
                episode = given if isinstance(given, Packed) else pack(given, fps, versions)
                key = f"{episode.spec.split}-{episode.spec.index:06d}"
                for name, data in episode.members.items():
                    tar.write({"__key__": key, name: data})  # one by one, to keep their order
                first = first if actions else episode.spec.index
                actions.append(episode.actions)
    lengths, sums = tuple(map(len, actions)), ActionSums.of(actions)
    return ShardRecord(path.name, first, lengths, file.size, file.sha256.hexdigest(), sums)


def pack(episode: Episode, fps: float, versions: Mapping[str, str]) -> Packed:
    """Encode `episode` as the members of a shard."""
    members = {
        "video.mkv": encode_video(episode.video, fps),
        "mask.mkv": encode_masks(episode.masks, fps),
        "actions.npy": to_npy(episode.actions),
        "states.npz": to_npz(episode.states),
        "contacts.npy": to_npy(episode.contacts),
    }
    return joined(
        episode.spec, episode.actions, members, versions, episode.factors, episode.ood_label
    )


def joined(
    spec: EpisodeSpec,
    actions: NDArray[np.float32],
    members: Mapping[str, bytes],
    versions: Mapping[str, str],
    factors: Mapping[str, Any],
    ood_label: str | None,
    facts: Mapping[str, Any] | None = None,
) -> Packed:
    """Join encoded members, all but ``json``, which is made here.

    Args:
        facts: what else is known of a recorded episode, e.g. its task.
    """
    about: dict[str, Any] = {
        "spec": spec.to_dict(),
        "factors": dict(factors),
        "ood_label": ood_label,
        "versions": dict(versions),
        "crc32": {name: zlib.crc32(data) for name, data in members.items()},
    }
    about |= {"facts": dict(facts)} if facts else {}
    data = json.dumps(about, sort_keys=True).encode()
    return Packed(spec, actions, {**members, "json": data})


class Member(NamedTuple):
    """The position and size in bytes of one member in its shard."""

    offset: int
    size: int


@dataclass(frozen=True)
class ShardReader:
    """Random access to the episodes of one shard by their position in it, from 0.

    Construct it with `open_shard`. It keeps no file open, so it can be sent to other processes. Its
    methods raise a `DataError` if something is missing or damaged.
    """

    path: Path  # the tar file
    episodes: tuple[Mapping[str, Member], ...]  # the members of every episode by name
    names: tuple[str, ...]  # file names of all members, in order
    _checksums: dict[int, Mapping[str, int]] = field(
        default_factory=dict[int, Mapping[str, int]], compare=False, repr=False
    )

    def __len__(self) -> int:
        return len(self.episodes)

    def read(self, position: int, name: str) -> bytes:
        """The bytes of member `name`, one of `MEMBERS`, checked against their checksum."""
        try:
            member = self.episodes[position][name]
            with self.path.open("rb", buffering=0) as file:
                data = os.pread(file.fileno(), member.size, member.offset)
        except LookupError:
            raise damaged_shard(self.path, f"episode {position} has no {name}") from None
        except FileNotFoundError:
            raise _missing(self.path) from None
        except OSError as error:
            raise damaged_shard(self.path, f"it cannot be read: {error.strerror}") from error
        if len(data) != member.size:
            raise damaged_shard(self.path, f"it ends within {name} of episode {position}")
        if name == "json":
            return data
        if position not in self._checksums:  # cached: parsing is slow
            self._checksums[position] = self.about(position)["crc32"]
        if self._checksums[position].get(name) != zlib.crc32(data):
            raise damaged_shard(self.path, f"{name} of episode {position} has another checksum")
        return data

    def decoded(self, position: int, name: str, decode: Callable[[bytes], Decoded]) -> Decoded:
        """What `decode` makes of the bytes of `read`."""
        data = self.read(position, name)
        try:
            return decode(data)
        except (DataError, *UNREADABLE) as error:
            raise damaged_shard(self.path, f"{name} of episode {position}: {error}") from error

    def array(self, position: int, name: str) -> NDArray[Any]:
        """A ``.npy`` member."""
        return self.decoded(position, name, from_npy)

    def about(self, position: int) -> dict[str, Any]:
        """The ``json`` member: spec, factors, ood_label, versions, crc32, and facts if recorded."""
        wanted = ("spec", "factors", "ood_label", "versions", "crc32")

        def parsed(data: bytes) -> dict[str, Any]:
            about = parse_json(data)
            return {name: about[name] for name in wanted} | {"facts": about.get("facts", {})}

        return self.decoded(position, "json", parsed)

    def episode(self, position: int, size: Sequence[int] | None = None) -> Episode:
        """Read and decode one whole episode, whose frames must have the height and width `size`."""
        about = self.about(position)
        actions = self.array(position, "actions.npy")
        most = len(actions) + 1 if actions.ndim else 0  # `Episode` names what differs by one
        whole = {"size": size, "length": most}
        return Episode(
            spec=EpisodeSpec.from_dict(about["spec"]),
            video=self.decoded(position, "video.mkv", functools.partial(decode_video, **whole)),
            actions=actions,
            states=self.decoded(position, "states.npz", from_npz),
            masks=self.decoded(position, "mask.mkv", functools.partial(decode_masks, **whole)),
            contacts=self.array(position, "contacts.npy"),
            factors=about["factors"],
            ood_label=about["ood_label"],
        )


def open_shard(path: Path) -> ShardReader:
    """Index the shard at `path`. The index is cached until the file changes.

    Raises:
        DataError: there is no such file, or it is not a complete tar file of episodes.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise _missing(path) from None
    return _index(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _index(path: Path, size: int, modified: int) -> ShardReader:
    episodes: dict[str, dict[str, Member]] = {}
    names: list[str] = []
    try:
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                key, _, name = info.name.partition(".")
                episodes.setdefault(key, {})[name] = Member(info.offset_data, info.size)
                names.append(info.name)
    except (tarfile.TarError, ValueError) as error:
        check_fetched(path)
        raise damaged_shard(path, str(error)) from error
    except OSError as error:
        raise damaged_shard(path, f"it cannot be read: {error.strerror}") from error
    return ShardReader(path, tuple(episodes.values()), tuple(names))


def damaged_shard(path: Path, reason: str) -> DataError:
    """The error for a shard that cannot be read."""
    return DataError(
        f"shard {path} is damaged ({reason}): delete it and run the command that made it again"
    )


def _missing(path: Path) -> DataError:
    return DataError(f"shard {path} is missing: run the command that made it again")
