"""The format of diffusion policy's replay buffers: Zarr arrays of all episodes in a row."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import re
import warnings
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numcodecs.abc
import numcodecs.errors
import numpy as np
import zarr
import zarr.errors
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.storage import LocalStore, ZipStore

from acwm_core.arrays import LARGE, check_unpacked
from acwm_core.errors import DataError, suggest
from acwm_core.files import check_fetched
from acwm_formats.array_store import ArrayLayout, ArrayStore, StoredEpisode, StoredEpisodes
from acwm_formats.channels import Channels
from acwm_formats.episode_bounds import bounds_of, check_agreement, is_clock, may_tell, tells
from acwm_formats.format import Format
from acwm_formats.frames import DENSE, MOST_FRAMES, stack_note
from acwm_formats.images import CHANNELS, MOST_BYTES, stacked
from acwm_formats.names import exact, pair, typed, word, words
from acwm_formats.packed import check_packed
from acwm_formats.sources import damage_of, guarded
from acwm_formats.texts import text_facts, text_note
from acwm_formats.timeline import RecordedDataset

ENDS = "meta/episode_ends"
PLACES = (
    ENDS,
    *("data/episode_ends", "episode_ends", "meta/episode_lengths", "data/episode_lengths"),
    *("episode_lengths", "meta/ep_len", "data/ep_len", "ep_len"),
)
"""Arrays that say where episodes end, or how long they are; the first that is there counts."""

NUMBERED = tuple(
    f"{group}{name}"
    for group in ("data/", "meta/", "")
    for name in ("episode_index", "episode_idx", "episode_id", "episode", "ep_idx", "traj_id")
)
"""Arrays that number the episode of each row, where no other tells episodes apart."""

ACTIONS = ("action", "actions")
NUMBERS, TEXTS = "fiub", "SUTO"
"""NumPy's kinds of dtypes that hold numbers, and of those that may hold texts."""

PACKERS = frozenset({"blosc", "zstd", "zlib", "lz4", "gzip", "bz2", "lzma"})
CODECS = PACKERS | {
    *("shuffle", "delta", "fixedscaleoffset", "astype", "bitround", "quantize", "packbits"),
    *("crc32", "crc32c", "adler32", "fletcher32", "bytes", "transpose", "sharding", "vlenutf8"),
}
"""Codecs of numbers. Others are refused: those of objects run code as they read."""

WIDEST = 8
"""How many times larger numbers may be as a filter has them than in the array."""

LEAST = 2**20
"""Bytes that a chunk may always unpack to: how many it does is known roughly before."""

MOST_PIECES = 2**16
"""Chunks of a row, or of a shard, all of which are listed to read one."""

MOST_LOOKED_AT = 1000  # files


class ZarrReplay(Format):
    """Zarr replay buffers as diffusion policy publishes them; read only."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether there is an array ``meta/episode_ends``, or it is called ``.zarr.zip``."""
        if path.name.lower().endswith(".zarr.zip"):
            return path.is_file()
        files = (".zarray", "zarr.json")
        return any(
            (path / place / file).is_file() for place in (*PLACES, *NUMBERED) for file in files
        )

    @guarded
    def read(
        self,
        root: Path,
        *,
        rate: float,
        video: str | None = None,
        actions: str | None = None,
        states: str | None = None,
        pixel_range: tuple[int, ...] | None = None,
        channels: Channels | None = None,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import a Zarr replay buffer with data/… of all episodes and meta/episode_ends.

        Other arrays that mark episodes, such as meta/episode_lengths, also work.

        Args:
            root: the folder, or a .zarr.zip file.
            rate: Frames per second, which the format does not store.
            video: Names of the frames in data, with a comma between; by default all images.
            actions: Name of the actions in data; action by default.
            states: Names of the states to keep; by default all other numbers.
            pixel_range: Values that are black and white, e.g. 0,1 or 0,65535.
            channels: What four channels are (rgba), or which of stacked grey frames is the newest.
            follow_links: Whether links may lead out of the folder.
        """
        buffer = Buffer(Path(root))
        names = [name for name in buffer.names() if not tells(name)]
        arrays = {name: buffer.array(f"data/{name}") for name in names}
        for name, array in sorted(arrays.items(), key=lambda item: -item[1].ndim):
            if array.ndim == 5:
                raise DataError(stacked(f"data/{name} of {root}", array.shape[1:]))
            if array.shape[0] != buffer.ends[-1]:
                rows = f"{array.shape[0]} rows, but the last episode ends at {buffer.ends[-1]}"
                raise DataError(f"data/{name} of {root} has {rows}")
        cameras = _chosen(buffer, video, arrays, [n for n in arrays if _shows(arrays[n])])
        action = _chosen(buffer, actions, arrays, [name for name in ACTIONS if name in arrays])[:1]
        if not cameras or not action:
            missing = "actions: give --actions NAME" if cameras else "images: give --video NAME"
            raise DataError(f"data/ of {root} has {', '.join(arrays)}, and no {missing}")
        others = [n for n in arrays if n not in (*cameras, *action) and arrays[n].ndim == 2]
        kept = _chosen(buffer, states, arrays, others)
        options = {"rate": rate, "video": video, "actions": actions, "states": states}
        name = Path(root).resolve().name
        options["channels"] = channels
        seen, known = {n: n for n in cameras}, {n: n for n in kept}
        layout = ArrayLayout("replay buffer", seen, action[0], known)
        recordings = StoredEpisodes(
            buffer.episodes(), layout, exact(rate), pair(pixel_range), channels
        )
        used = {*cameras, *action, *kept}
        left = [name for name in arrays if name not in used] + buffer.groups()
        return RecordedDataset(
            name=word(Path(root)),
            splits=recordings,
            facts={
                "kind": "zarr",
                "name": name,
                "episodes": len(buffer.ends),
                "frames": buffer.ends[-1],
            },
            options=options | {"pixel_range": typed(pixel_range), "follow_links": follow_links},
            notes=_notes(buffer, cameras, recordings, left),
            summary=f"The replay buffer {name}",
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """A buffer of three short episodes."""
        place, rng = folder / "square.zarr", np.random.default_rng(0)
        store = zarr.open_group(str(place), mode="w", zarr_format=2)
        frames = rng.integers(0, 256, (18, 32, 32, 3), np.uint8)
        store.create_array("data/img", data=frames, chunks=(1, 32, 32, 3))
        store.create_array("data/action", data=rng.uniform(-1, 1, (18, 2)).astype(np.float32))
        store.create_array("data/state", data=rng.uniform(-1, 1, (18, 5)).astype(np.float32))
        store.create_array(ENDS, data=np.array([5, 11, 18]))
        return {"root": place, "rate": 10.0}


def _notes(
    buffer: Buffer, cameras: Iterable[str], recordings: StoredEpisodes, left: list[str]
) -> tuple[str, ...]:
    """What people should know about how the buffer was read."""
    notes = [f"Arrays that were left out: {', '.join(left)}."] if left else []
    for name in cameras:
        array = buffer.array(f"data/{name}")
        if array.nbytes > LARGE + DENSE * (stored := array.nbytes_stored()):
            raise DataError(f"{name} of {buffer.path} claims {array.nbytes:,} bytes in {stored:,}")
        if lacking := array.nchunks - array.nchunks_initialized:
            notes.append(
                f"{lacking} of {array.nchunks} chunks of {name} are not stored, and read as "
                f"{array.fill_value}: a copy may lack files."
            )
    with contextlib.suppress(DataError):
        first = recordings[0]
        notes += [*stack_note(first.cameras.values()), *text_note(first.facts)]
    return tuple(notes)


@dataclass(frozen=True)
class _Measure(BytesBytesCodec):
    """Stands before a codec as chunks are read, and refuses those that unpack to too much.

    Attributes:
        codec: the name of the codec that comes next.
        most: how many bytes a chunk may unpack to; None for texts.
    """

    codec: str
    most: int | None

    async def _decode_single(self, chunk_data: Any, chunk_spec: Any) -> Any:
        check_packed(chunk_data.to_bytes(), self.codec, self.most)
        return chunk_data

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: Any) -> int:
        """As in `BytesBytesCodec`: it leaves chunks as they are."""
        return input_byte_length


class _Measured(numcodecs.abc.Codec):
    """A codec of Zarr's version 2 that refuses chunks which unpack to too much."""

    codec_id = "measured"

    def __init__(self, codec: Any, most: int | None) -> None:
        self._codec, self._most = codec, most

    def encode(self, buf: Any) -> Any:
        """As in `Codec`."""
        return self._codec.encode(buf)

    def decode(self, buf: Any, out: Any = None) -> Any:
        """As in `Codec`.

        Raises:
            ValueError: the bytes unpack to far more than they are, or than they may.
        """
        check_packed(memoryview(buf).cast("B"), _kind(self._codec), self._most)
        return self._codec.decode(buf, out)


def _kind(codec: Any) -> str:
    """The name of a codec, without what the versions of Zarr add to it."""
    name = getattr(codec, "codec_id", type(codec).__name__)
    return name.lower().removesuffix("codec").replace("-", "")


def _parts(codecs: Iterable[Any]) -> Iterator[Any]:
    """Codecs, and those within them: of shards, and of version 2."""
    for codec in codecs:
        if hasattr(codec, "compressor"):
            yield from (part for part in (*(codec.filters or ()), codec.compressor) if part)
        else:
            yield codec
            yield from _parts(getattr(codec, "codecs", ()))


def _measured(codecs: Iterable[Any], most: int | None) -> Iterator[Any]:
    """The same codecs, which measure chunks before they unpack them."""
    for codec in codecs:
        if hasattr(codec, "compressor"):
            packed = codec.compressor and _Measured(codec.compressor, most)
            filters = tuple(_Measured(part, most) for part in codec.filters or ())
            yield replace(codec, compressor=packed, filters=filters)
            continue
        shards = hasattr(codec, "codecs")
        yield replace(codec, codecs=tuple(_measured(codec.codecs, most))) if shards else codec
        if _kind(codec) in (*PACKERS, "vlenutf8"):
            yield _Measure(_kind(codec), most)


class Buffer(ArrayStore):
    """The arrays of a replay buffer, opened anew in every process.

    Raises:
        DataError: it is no Zarr group that can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._found: dict[str, Any] = {}
        self._read: dict[str, list[Any]] = {}
        with damage_of(path), _pointers_named(path):
            if path.is_file():
                with ZipFile(path) as packed:
                    sizes = (member.file_size for member in packed.infolist())
                    check_unpacked(path.stat().st_size, sum(sizes))
            kind: Any = ZipStore if path.is_file() else LocalStore
            store = kind(path.absolute(), read_only=True)
            self._group: Any = zarr.open_group(store, mode="r")

    def __reduce__(self) -> Any:
        return Buffer, (self.path,)

    def names(self, kinds: str = NUMBERS, group: str = "data") -> list[str]:
        """The names of the arrays in a group but for hidden ones.

        Args:
            kinds: which, by NumPy's kinds of dtypes.
            group: the name of the group.
        """
        with damage_of(self.path / group), _pointers_named(self.path / group):
            arrays = (self._group[group] if group else self._group).arrays()
            return sorted(n for n, a in arrays if a.dtype.kind in kinds and not n.startswith("."))

    def groups(self) -> list[str]:
        """The names of the groups in ``data``, none of which is read."""
        with damage_of(self.path / "data"), _pointers_named(self.path / "data"):
            return sorted(f"{name}/" for name, _ in self._group["data"].groups())

    def array(self, name: str) -> Any:
        """An array of numbers or texts whose codecs run no code.

        Raises:
            DataError: there is no such array, or it cannot be read.
        """
        if name in self._found:
            return self._found[name]
        with damage_of(self.path / name), _pointers_named(self.path / name):
            array = self._group[name]
            pipeline = array.async_array.codec_pipeline
            parts = [*_parts(pipeline)]
            used = [_kind(codec) for codec in parts]
        if array.dtype.kind not in NUMBERS + TEXTS:
            raise DataError(f"{name} of {self.path} holds {array.dtype}, not numbers")
        if unknown := [codec for codec in used if codec not in CODECS]:
            raise DataError(
                f"{name} of {self.path} is stored by {unknown[0]}, which is not read: store it "
                "again with another codec, such as zstd"
            )
        if (times := sum(codec in PACKERS for codec in used)) > 1:
            raise DataError(
                f"{name} of {self.path} is compressed {times} times: store it with one codec"
            )
        row, chunk = (
            math.prod(shape) * array.dtype.itemsize
            for shape in (array.shape[1:], array.shards or array.chunks)
        )
        if max(chunk / 2, row) > MOST_BYTES:
            raise DataError(
                f"{name} of {self.path} claims rows {list(array.shape[1:])} in chunks of {chunk:,} "
                "bytes, more than are read"
            )
        grain = [array.chunks, *(part.chunk_shape for part in parts if _kind(part) == "sharding")][
            -1
        ]
        whole = array.shards or (grain[:1] + array.shape[1:])
        if (
            pieces := math.prod(-(-size // step) for size, step in zip(whole, grain, strict=True))
        ) > MOST_PIECES:
            raise DataError(f"{name} of {self.path} claims {pieces:,} chunks in a row or shard")
        most = max(WIDEST * chunk, LEAST) if array.dtype.kind in NUMBERS else None
        measured = pipeline.from_codecs([*_measured(pipeline, most)])
        object.__setattr__(array.async_array, "codec_pipeline", measured)  # it is a frozen class
        self._found[name] = array
        return array

    def length(self, name: str) -> int:
        """As in `ArrayStore`."""
        return self.array(f"data/{name}").shape[0]

    def rows(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """As in `ArrayStore`."""
        return self._rows(f"data/{name}", start, stop)

    def _rows(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        array = self.array(name)
        count = (array.shape[0] if stop is None else stop) - start
        if count * math.prod(array.shape[1:]) * array.dtype.itemsize > 4 * MOST_BYTES:
            raise DataError(f"{name} of {self.path} claims {count:,} rows, more than are read")
        with damage_of(f"{name} of {self.path}"), _pointers_named(self.path / name):
            return np.asarray(array[start:stop])

    def episodes(self) -> dict[int, StoredEpisode]:
        """The episodes by number; raises as `ends`."""
        bounds, count = enumerate(itertools.pairwise([0, *self.ends])), len(self.ends)
        return {number: StoredEpisode(self, number, count, *rows) for number, rows in bounds}

    def description(self, episode: StoredEpisode) -> tuple[dict[str, Any], None]:
        """As in `ArrayStore`: texts of each row in ``data``, and of each episode in ``meta``."""
        rows, number = slice(episode.start, episode.stop), episode.number or 0
        own = {name: self._texts(f"data/{name}")[rows] for name in self.names(TEXTS)}
        if "meta" in self._group:
            known = {name: self._texts(f"meta/{name}") for name in self.names(TEXTS, "meta")}
            own |= {n: t[number : number + 1] for n, t in known.items() if len(t) == episode.count}
        return dict(text_facts(own)), None

    def _texts(self, name: str) -> list[Any]:
        """All texts in an array, which are read once."""
        if name not in self._read:
            self._read[name] = self._rows(name).reshape(-1).tolist()
        return self._read[name]

    @functools.cached_property
    def ends(self) -> list[int]:
        """Where each episode ends.

        Raises:
            DataError: nothing says it, or what does contradicts itself.
        """
        ends = self._stored_ends()
        edges = [*itertools.pairwise([0, *ends])]
        for group in ("data", "meta", ""):
            if not group or group in self._group:
                arrays = {name: self.array(f"{group}/{name}") for name in self.names(group=group)}
                known = {
                    name: self._rows(f"{group}/{name}")
                    for name, array in arrays.items()
                    if array.ndim in (1, 2) and (tells(name) or is_clock(name))
                }
                check_agreement(known, edges, ends[-1], f"{self.path} ({group or 'its root'})")
        return ends

    def _stored_ends(self) -> list[int]:
        """Where each episode ends, by the first array that says it; raises as `ends`."""
        place = next((name for name in (*PLACES, *NUMBERED) if name in self._group), None)
        if place is None:
            return self._ends_by_content()
        if (count := self.array(place).shape[0]) > MOST_FRAMES:
            raise DataError(f"{place} of {self.path} claims {count:,} episodes")
        if place in NUMBERED:
            numbers, name = self._rows(place), place.rpartition("/")[2]
            whole = bounds_of({name: numbers}, len(numbers), f"{place} of {self.path}")
            return [stop for _, stop in whole or [(0, len(numbers))]]
        if place != ENDS and not place.endswith("episode_ends"):
            lengths = self._rows(place)
            count, name = int(lengths.sum()), place.rpartition("/")[2]
            whole = bounds_of({name: lengths}, count, f"{place} of {self.path}") or [(0, count)]
            return [stop for _, stop in whole]
        ends = [int(end) for end in self._rows(place)]
        if not ends or any(end <= start for start, end in itertools.pairwise([0, *ends])):
            raise DataError(f"{ENDS} of {self.path} does not grow with each episode: {ends[:5]}")
        return ends

    def _ends_by_content(self) -> list[int]:
        """Where episodes end, by arrays of other names; raises as `ends`."""
        groups = [f"{name}/" for name, _ in self._group.groups()]
        names = [f"{group}{name}" for group in ("", *groups) for name in self.names(group=group)]
        count = max((self.length(name) for name in self.names()), default=0)
        candidates = {
            n: self.array(n) for n in names if may_tell(n.rpartition("/")[2], self.array(n), count)
        }
        arrays = {
            n.rpartition("/")[2]: self._rows(n) for n, a in candidates.items() if a.ndim in (1, 2)
        }
        bounds = bounds_of(arrays, count, str(self.path))
        if bounds is None:
            raise DataError(f"nothing in {self.path} says where episodes end: store {ENDS}")
        return [stop for _, stop in bounds]


@contextlib.contextmanager
def _pointers_named(root: Path) -> Generator[None]:
    """Where the block fails, report files that Git LFS has not fetched, or an unknown codec.

    Zarr's own warnings are left out: of files of other programs beside the arrays, for example.
    """
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            yield
    except (numcodecs.errors.UnknownCodecError, zarr.errors.UnknownCodecError) as error:
        codec = re.sub(r".*: |['\"]", "", str(error))
        raise DataError(
            f"{root} has arrays stored by {codec}, which is not read: store them again with "
            "another codec, such as zstd"
        ) from error
    except Exception:
        for path in itertools.islice(root.rglob("*"), MOST_LOOKED_AT):
            if path.is_file():
                check_fetched(path)
        raise


def _shows(array: Any) -> bool:
    return array.ndim == 4 and (array.shape[3] in CHANNELS or array.shape[1] in CHANNELS)


def _chosen(
    buffer: Buffer, text: str | None, arrays: Mapping[str, Any], default: list[str]
) -> list[str]:
    """The names in `text`, or the default ones."""
    names = default if text is None else list(words(text))
    for name in names:
        if name not in arrays:
            raise DataError(f"{buffer.path} has no data/{name}{suggest(name, arrays)}")
    return names
