"""Shards: WebDataset tar files of whole episodes, equal episodes giving equal bytes.

The members of episode 12 of `train`, in this order:

    train-000012.video.mkv     lossless RGB video
    train-000012.mask.mkv      lossless instance ids
    train-000012.actions.npy   float32 [T, A], raw units, last row zero
    train-000012.states.npz    one array [T, …] per state field
    train-000012.contacts.npy  int32 [K, 3] rows (frame, id, id)
    train-000012.json          spec, factors, ood_label, versions, crc32 of the members above

A reader indexes a shard's headers once and then reads single members at their offsets.
"""

from __future__ import annotations

import functools
import io
import json
import os
import tarfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.atomic import written_whole
from acwm_core.data.video import decode_masks, decode_video, encode_masks, encode_video
from acwm_core.episode import Episode, EpisodeSpec
from acwm_core.errors import AcwmError, DataError

MEMBERS = ("video.mkv", "mask.mkv", "actions.npy", "states.npz", "contacts.npy", "json")
ABOUT = ("spec", "factors", "ood_label", "versions", "crc32")
EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip archive can hold


def write_shard(
    path: Path, episodes: Iterable[Episode], fps: int, versions: Mapping[str, str]
) -> None:
    """Write `episodes` to the tar file `path`, which appears only once it is complete.

    Args:
        path: final name; its folder must exist.
        episodes: taken one at a time, so that a lazy iterable needs the memory of one.
        fps: frame rate noted in the videos.
        versions: recorded with every episode.
    """
    with (
        written_whole(path) as partial,
        tarfile.open(partial, "w", format=tarfile.USTAR_FORMAT) as tar,
    ):
        for episode in episodes:
            key = f"{episode.spec.split}-{episode.spec.index:06d}"
            for name, data in pack(episode, fps, versions).items():
                # TarInfo's own defaults: owner 0, mode 0644, time 0.
                member = tarfile.TarInfo(f"{key}.{name}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))


def pack(episode: Episode, fps: int, versions: Mapping[str, str]) -> dict[str, bytes]:
    """The members of `episode` by name, in the order in which a shard holds them."""
    members = {
        "video.mkv": encode_video(episode.video, fps),
        "mask.mkv": encode_masks(episode.masks, fps),
        "actions.npy": _npy(episode.actions),
        "states.npz": _npz(episode.states),
        "contacts.npy": _npy(episode.contacts),
    }
    about = {
        "spec": episode.spec.to_dict(),
        "factors": dict(episode.factors),
        "ood_label": episode.ood_label,
        "versions": dict(versions),
        "crc32": {name: zlib.crc32(data) for name, data in members.items()},
    }
    return {**members, "json": json.dumps(about, sort_keys=True).encode()}


@dataclass(frozen=True)
class Member:
    """Where the bytes of one member lie in its shard."""

    offset: int
    size: int


@dataclass(frozen=True)
class ShardReader:
    """Random access to the episodes of one shard by their position in it, from 0.

    Construct it with `open_shard`. It keeps no file open, so it may cross into other processes.

    Attributes:
        path: the tar file.
        episodes: the members of every episode by name.
    """

    path: Path
    episodes: tuple[Mapping[str, Member], ...]

    def __len__(self) -> int:
        return len(self.episodes)

    def read(self, position: int, name: str) -> bytes:
        """The bytes of member `name`, one of `MEMBERS`, checked against their checksum.

        Raises:
            DataError: it is missing or damaged.
        """
        data = self._bytes(position, name)
        if name != "json" and self.about(position)["crc32"].get(name) != zlib.crc32(data):
            raise _damaged(self.path, f"{name} of episode {position} has another checksum")
        return data

    def _bytes(self, position: int, name: str) -> bytes:
        try:
            member = self.episodes[position][name]
        except KeyError:
            raise _damaged(self.path, f"episode {position} has no {name}") from None
        try:
            with self.path.open("rb", buffering=0) as file:
                data = os.pread(file.fileno(), member.size, member.offset)
        except FileNotFoundError:
            raise _missing(self.path) from None
        if len(data) != member.size:
            raise _damaged(self.path, f"it ends within {name} of episode {position}")
        return data

    def array(self, position: int, name: str) -> NDArray[Any]:
        """A ``.npy`` member; pickled objects are refused.

        Raises:
            DataError: it cannot be read.
        """
        data = self.read(position, name)
        with _blaming(self.path, position, name):
            return cast(NDArray[Any], np.load(io.BytesIO(data), allow_pickle=False))

    def about(self, position: int) -> dict[str, Any]:
        """The ``json`` member: spec, factors, ood_label, versions, crc32.

        Raises:
            DataError: it cannot be read.
        """
        data = self.read(position, "json")
        with _blaming(self.path, position, "json"):
            about = json.loads(data)
            return {name: about[name] for name in ABOUT}

    def episode(self, position: int) -> Episode:
        """Everything about one episode.

        Raises:
            DataError: a member is damaged or missing.
        """
        about = self.about(position)
        with _blaming(self.path, position, "video.mkv"):
            video = decode_video(self.read(position, "video.mkv"))
        with _blaming(self.path, position, "mask.mkv"):
            masks = decode_masks(self.read(position, "mask.mkv"))
        with _blaming(self.path, position, "states.npz"):
            packed = np.load(io.BytesIO(self.read(position, "states.npz")), allow_pickle=False)
            states = {name: packed[name] for name in packed.files}
        actions = self.array(position, "actions.npy")
        contacts = self.array(position, "contacts.npy")
        with _blaming(self.path, position, "json"):
            spec = EpisodeSpec.from_dict(about["spec"])
            factors, label = about["factors"], about["ood_label"]
            return Episode(spec, video, actions, states, masks, contacts, factors, label)


def open_shard(path: Path) -> ShardReader:
    """Index the shard at `path`; the index stays in memory as long as the file is the same.

    Raises:
        DataError: there is no such file, or it is not a whole tar file of episodes.
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
        with tarfile.open(path, "r:") as tar:
            for info in tar:
                key, _, name = Path(info.name).name.partition(".")
                episodes.setdefault(key, {})[name] = Member(info.offset_data, info.size)
            end = tar.offset
    except (tarfile.TarError, ValueError, EOFError) as error:
        raise _damaged(path, str(error)) from error
    if end + tarfile.BLOCKSIZE > size:  # tarfile takes a cut between members for the end
        raise _damaged(path, "its end is cut off")
    return ShardReader(path, tuple(episodes.values()))


class _blaming:
    """Turns any failure to decode a member into a `DataError` that names it."""

    def __init__(self, path: Path, position: int, name: str) -> None:
        self._path, self._what = path, f"{name} of episode {position}"

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, DataError) and str(self._path) in str(error):
            return
        if isinstance(error, (AcwmError, ValueError, KeyError, TypeError, zipfile.BadZipFile)):
            raise _damaged(self._path, f"{self._what}: {error}") from error


def _missing(path: Path) -> DataError:
    return DataError(f"shard {path} is missing: run the acwm generate command that made it again")


def _damaged(path: Path, reason: str) -> DataError:
    return DataError(
        f"shard {path} is damaged ({reason}): delete it and run the acwm generate command that "
        "made it again"
    )


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def _npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An ``.npz`` whose bytes depend on the arrays alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", EPOCH), _npy(arrays[name]))
    return buffer.getvalue()
