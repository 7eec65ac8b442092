"""A folder of tasks: what a participant is given, and nothing of the truth.

TASKS/README.md, benchmark.json, index.jsonl, SHA256SUMS
TASKS/WORLD/ID.png           the first frame (ID-0.png … ID-K.png for several)
TASKS/WORLD/ID.npz           the actions
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.arrays import load_npz
from acwm_core.data.shards import file_sha256
from acwm_core.env.episode import SPLITS
from acwm_core.errors import DataError, suggest
from acwm_core.files import parse_json, plain_name, read_json, regular_file, typed

BENCHMARK, INDEX, SUMS, README = "benchmark.json", "index.jsonl", "SHA256SUMS", "README.md"

OVERHEAD = 2**20
"""Bytes by which an NPZ file may be larger than its array."""


@dataclass(frozen=True)
class BenchmarkWorld:
    """One world of a benchmark, without its tasks.

    Attributes:
        name: registered name of the environment.
        summary: what it is, for people.
        size: height and width of frames.
        fps: frames per second.
        actions: names, units, low and high bounds and kind of the action's dimensions.
        evaluation: the settings of its evaluation, as `EvaluationConfig` takes them.
        checksums: SHA-256 of the true test data, by split.
        episodes: number of episodes of that data, by split.
        branch_frames: the most frames of a counterfactual branch.
        source: kind and name of recorded data; empty if the data was simulated.
        seed: the seed of the data; None if it is secret, or if the data was recorded.
    """

    name: str
    summary: str
    size: tuple[int, int]
    fps: float
    actions: dict[str, Any]
    evaluation: dict[str, Any]
    checksums: dict[str, str]
    episodes: dict[str, int]
    branch_frames: int
    source: dict[str, Any] = field(default_factory=dict[str, Any])
    seed: int | None = None

    def __post_init__(self) -> None:
        plain_name(self.name, "a world")
        if not set(self.checksums) <= set(SPLITS):
            raise ValueError(f"{', '.join(self.checksums)} are not splits")


@dataclass(frozen=True)
class BenchmarkTask:
    """One clip to predict: a line of the index.

    Attributes:
        id: ``WORLD/NAME``; the name of its files, and of the prediction's.
        world: registered name of the environment.
        frames: number of frames of the whole clip, T, the given ones included.
        given: number of given first frames, K.
        images: the files of the given frames, PNG.
        actions: the NPZ file with ``actions`` `[T, A]`; row i leads from frame i to i + 1, and the
            last one, which leads to no frame, is zero.
        seed: seeds noise if a model has any; equal for all tasks that start from the same clip.
        branch: whether it starts like a test clip and takes other actions; one draw is enough.
    """

    id: str
    world: str
    frames: int
    given: int
    images: list[str]
    actions: str
    seed: int
    branch: bool


@dataclass(frozen=True)
class Benchmark:
    """``benchmark.json``: all worlds by name, and the version of the layout."""

    worlds: dict[str, BenchmarkWorld]
    version: int = 1

    def __post_init__(self) -> None:
        for name, world in self.worlds.items():
            if world.name != name:
                raise ValueError(f"the world {world.name!r} is called {name!r}")


class Tasks:
    """A folder of tasks that `acwm benchmark export` wrote.

    Raises:
        DataError: there is none, or it is damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not all((self.folder / name).exists() for name in (BENCHMARK, INDEX)):
            raise DataError(
                f"{self.folder} holds no tasks ({BENCHMARK}, {INDEX}): make them with "
                "`acwm benchmark export`, or take the organiser's folder"
            )
        benchmark = regular_file(self.folder, BENCHMARK)
        self.benchmark = read_json(benchmark, Benchmark, "the benchmark")
        index = regular_file(self.folder, INDEX)
        try:
            lines = index.read_text(encoding="utf-8").splitlines()
            self.all = [typed(parse_json(line), BenchmarkTask) for line in lines]
            for task in self.all:
                self._check(task)
        except ValueError as error:
            raise DataError(f"{index} is damaged ({error})") from error

    def _check(self, task: BenchmarkTask) -> None:
        if task.world not in self.benchmark.worlds:
            raise ValueError(f"{BENCHMARK} has no world {task.world!r}")
        world, _, name = task.id.partition("/")
        if world != task.world:
            raise ValueError(f"the task {task.id!r} is of the world {task.world!r}")
        plain_name(name, "a task")

    @property
    def checksum(self) -> str:
        """SHA-256 of the index."""
        return file_sha256(self.folder / INDEX)

    def worlds(self, names: Sequence[str] = ()) -> list[BenchmarkWorld]:
        """The worlds with these names, all by default; a `DataError` for others."""
        known = self.benchmark.worlds
        for name in names:
            if name not in known:
                if "=" in name:
                    raise DataError(
                        f"{name} is a setting of the evaluation, and {self.folder} has them "
                        f"already: give it to `acwm benchmark export`"
                    )
                raise DataError(f"{self.folder} has no tasks of {name!r}{suggest(name, known)}")
        return [known[name] for name in (names or known)]

    def of(self, world: str) -> list[BenchmarkTask]:
        """The tasks of a world."""
        return [task for task in self.all if task.world == world]

    def actions(self, task: BenchmarkTask) -> NDArray[np.float32]:
        """The actions of a task, `[T, A]`."""
        wanted = task.frames, len(self.benchmark.worlds[task.world].actions["names"])

        def check(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
            if shape != wanted or dtype != np.float32:
                raise DataError(
                    f"{task.actions} holds {dtype} {[*shape]}, not float32 {[*wanted]}: export the "
                    "tasks again"
                )

        path = regular_file(self.folder, task.actions)
        return read_array(path, "actions", check, math.prod(wanted) * 4)


def read_array(
    path: Path, name: str, check: Callable[[tuple[int, ...], np.dtype[Any]], None], most_bytes: int
) -> NDArray[Any]:
    """Read the array `name`, the only one of an NPZ file.

    Args:
        check: called with shape and dtype before anything is unpacked; raises a `DataError` if they
            are not those wanted.
        most_bytes: size of the largest array that is wanted; a file that is much larger is refused.

    Raises:
        DataError: it is damaged, or holds something else or more.
    """
    if (size := path.stat().st_size) > most_bytes + OVERHEAD:
        raise DataError(f"{path.name} has {size:,} bytes, more than the {most_bytes:,} allowed")

    def is_wanted(found: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if found != name:
            raise DataError(f"{path.name} holds {found:.40}: give {name!r} alone")
        check(shape, dtype)

    try:
        arrays = load_npz(path, is_wanted)
    except (OSError, ValueError) as error:
        raise DataError(f"{path.name} cannot be read ({error!s:.200})") from error
    if not arrays:
        raise DataError(f"{path.name} holds nothing, not {name!r}")
    return arrays[name]


def write_index(
    folder: Path, worlds: Mapping[str, BenchmarkWorld], tasks: Iterable[BenchmarkTask]
) -> None:
    """Write ``benchmark.json``, the index and, last, the checksums of all files."""
    text = json.dumps(asdict(Benchmark(dict(worlds))), indent=1, ensure_ascii=False)
    (folder / BENCHMARK).write_text(text + "\n", encoding="utf-8")
    lines = [json.dumps(asdict(task)) + "\n" for task in tasks]
    (folder / INDEX).write_text("".join(lines), encoding="utf-8")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    sums = [f"{file_sha256(path)}  {path.relative_to(folder).as_posix()}\n" for path in files]
    (folder / SUMS).write_text("".join(sums), encoding="utf-8")
