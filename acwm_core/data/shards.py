"""Shards: WebDataset tar files of whole episodes. Equal episodes give equal bytes.

`readme.md.j2` describes the members of an episode, which are stored in the order of `MEMBERS`.
A reader indexes a shard's headers once and then reads single members at their offsets. It trusts
nothing: content that acwm never writes is refused with a clear message before it takes memory.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import math
import os
import re
import tarfile
import tokenize
import zipfile
import zlib
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.atomic import written_whole
from acwm_core.data.video import Limits, decode_masks, decode_video, encode_masks, encode_video
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.errors import AcwmError, DamagedShardError, DataError
from acwm_core.untrusted import parse_json

MEMBERS = ("video.mkv", "mask.mkv", "actions.npy", "states.npz", "contacts.npy", "json")
NAME = re.compile(rf"([a-z_]+-[0-9]{{6,9}})\.({'|'.join(map(re.escape, MEMBERS))})")
"""Pattern of a member's file name: the episode's key, a dot, and one of `MEMBERS`."""
ARRAYS = {"actions.npy": np.float32, "contacts.npy": np.int32}
"""Types of the ``.npy`` members; both have two axes."""

MAX_JSON = 2**20
"""Largest accepted JSON member in bytes; those that acwm writes have under a thousand."""

UNREADABLE = (
    *(ValueError, LookupError, TypeError, EOFError, ArithmeticError, RuntimeError),
    *(SyntaxError, tokenize.TokenError),  # from the header of a .npy file
)
"""Exceptions that decoding a damaged member raises, besides `zipfile.BadZipFile`."""


def write_shard(
    path: Path, episodes: Iterable[Episode], fps: int, versions: Mapping[str, str]
) -> None:
    """Write `episodes` to the tar file `path`, which appears only once it is complete.

    Args:
        path: final name; its folder must exist.
        episodes: taken one at a time, so a lazy iterable needs memory for only one.
    """
    from webdataset.writer import TarWriter  # pyright: ignore  (imports torch)

    with (
        written_whole(path) as partial,
        partial.open("wb") as file,
        TarWriter(file, encoder=False, user="", group="", mode=0o644, mtime=0) as tar,
    ):
        for episode in episodes:
            key = f"{episode.spec.split}-{episode.spec.index:06d}"
            for name, data in pack(episode, fps, versions).items():
                tar.write({"__key__": key, name: data})  # one by one, to keep their order


def pack(episode: Episode, fps: int, versions: Mapping[str, str]) -> dict[str, bytes]:
    """Encode `episode` as the members of a shard: bytes by name, in the order of `MEMBERS`."""
    members = {
        "video.mkv": encode_video(episode.video, fps),
        "mask.mkv": encode_masks(episode.masks, fps),
        "actions.npy": to_npy(episode.actions),
        "states.npz": to_npz(episode.states),
        "contacts.npy": to_npy(episode.contacts),
    }
    about = {
        "spec": episode.spec.to_dict(),
        "factors": dict(episode.factors),
        "ood_label": episode.ood_label,
        "versions": dict(versions),
        "crc32": {name: zlib.crc32(data) for name, data in members.items()},
    }
    return {**members, "json": json.dumps(about, sort_keys=True).encode()}


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

    @contextlib.contextmanager
    def decoding(self, position: int, name: str) -> Generator[bytes]:
        """Yield the bytes of `read`; errors of the block in decoding become `DamagedShardError`."""
        data = self.read(position, name)
        try:
            yield data
        except (AcwmError, zipfile.BadZipFile, *UNREADABLE) as error:
            raise damaged_shard(self.path, f"{name} of episode {position}: {error}") from error

    def array(self, position: int, name: str) -> NDArray[Any]:
        """A ``.npy`` member; pickled objects are refused."""
        with self.decoding(position, name) as data:
            array = from_npy(data)
            if array.dtype != ARRAYS[name] or array.ndim != 2:
                raise ValueError(f"it is {array.dtype} {array.shape}")
            return array

    def about(self, position: int) -> dict[str, Any]:
        """The ``json`` member: spec, factors, ood_label, versions, crc32."""
        with self.decoding(position, "json") as data:
            if len(data) > MAX_JSON:
                raise ValueError(f"it has {len(data)} bytes")
            about = parse_json(data)
            if not (isinstance(about, dict) and isinstance(about["crc32"], dict)):
                raise ValueError("it, or its crc32, is not a JSON object")
            wanted = ("spec", "factors", "ood_label", "versions", "crc32")
            return {name: about[name] for name in wanted}

    def episode(self, position: int, size: tuple[int, int] | None = None) -> Episode:
        """Read and decode one whole episode.

        Args:
            position: its position in the shard, from 0.
            size: height and width of its frames, if known; a video of another size is refused
                before it is decoded.
        """
        about = self.about(position)
        actions = self.array(position, "actions.npy")
        limits = Limits(len(actions), size)
        with self.decoding(position, "video.mkv") as data:
            video = decode_video(data, limits=limits)
        with self.decoding(position, "mask.mkv") as data:
            masks = decode_masks(data, limits=limits)
        with self.decoding(position, "states.npz") as data:
            states = from_npz(data)
        contacts = self.array(position, "contacts.npy")
        with self.decoding(position, "json"):
            spec = EpisodeSpec.from_dict(about["spec"])
            factors, label = about["factors"], about["ood_label"]
            return Episode(spec, video, actions, states, masks, contacts, factors, label)


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
    try:
        with path.open("rb") as file:
            # Parse headers one by one. `tarfile` would read tar extensions of any size.
            while any(block := file.read(tarfile.BLOCKSIZE)):  # tars end with empty blocks
                if len(block) < tarfile.BLOCKSIZE:
                    break
                info = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
                offset = file.tell()
                found = NAME.fullmatch(info.name)
                if found is None:
                    raise ValueError(f"it holds {info.name[:80]!r}, not part of an episode")
                if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
                    raise ValueError(f"{info.name} is a link or another special file")
                if not 0 <= info.size <= size - offset:
                    raise ValueError(f"its end is cut off: it ends within {info.name}")
                key, name = found.groups()
                members = episodes.setdefault(key, {})
                if name in members:
                    raise ValueError(f"it holds {info.name} twice")
                members[name] = Member(offset, info.size)
                file.seek(offset + -(-info.size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE)
            if len(block) < tarfile.BLOCKSIZE:
                raise ValueError("its end is cut off")
    except (tarfile.TarError, ValueError) as error:
        raise damaged_shard(path, str(error)) from error
    except OSError as error:
        raise damaged_shard(path, f"it cannot be read: {error.strerror}") from error
    names = (f"{key}.{name}" for key, members in episodes.items() for name in members)
    return ShardReader(path, tuple(episodes.values()), tuple(names))


def damaged_shard(path: Path, reason: str) -> DamagedShardError:
    """The error for a shard that cannot be read."""
    return DamagedShardError(
        f"shard {path} is damaged ({reason}): delete it and run the command that made it again"
    )


def _missing(path: Path) -> DataError:
    return DataError(f"shard {path} is missing: run the command that made it again")


def to_npy(array: NDArray[Any]) -> bytes:
    """The bytes of a ``.npy`` file."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def from_npy(data: bytes) -> NDArray[Any]:
    """The array in a ``.npy`` file of version 1; its size in bytes must match the header."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"it is a .npy file of version {version}")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are never loaded")
    if dtype.kind not in "biuf":
        raise ValueError(f"it holds {dtype}, not numbers")
    held, claimed = len(data) - stream.tell(), math.prod(shape) * dtype.itemsize
    if held != claimed or min(shape, default=0) < 0:
        raise ValueError(f"it claims {dtype} {shape}, {claimed} bytes, and holds {held}")
    flat = np.frombuffer(data, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()


def to_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The bytes of an ``.npz`` file; they depend only on the arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), to_npy(arrays[name]))  # dated 1980
    return buffer.getvalue()


def from_npz(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an uncompressed ``.npz``, whose size in bytes must match what it claims."""
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        infos = archive.infolist()
        if sum(info.file_size for info in infos) > len(data):
            raise ValueError(f"it claims more than its {len(data)} bytes can hold")
        for info in infos:
            name = info.filename.removesuffix(".npy")
            if info.compress_type != zipfile.ZIP_STORED or name in arrays:
                raise ValueError(f"{info.filename!r} is compressed, or there twice")
            arrays[name] = from_npy(archive.read(info))
    return arrays
