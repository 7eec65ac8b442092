"""Predictions as participants hand them in: found by the ids of tasks, checked, and read."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_benchmark.lossy import LossyClip
from acwm_benchmark.tasks import BenchmarkTask, BenchmarkWorld
from acwm_benchmark.videos import CONTAINERS, NPZ, Coding, coding_of, pictures_in, read_whole
from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError, suggest
from acwm_core.files import check_regular, inside, regular_file

TOLD = 5
"""Largest number of faults that one error lists."""

_DRAW = re.compile(r"(.+)\.(\d+)")


@dataclass(frozen=True)
class Predictions:
    """The predictions of one world's tasks: for each id the file or folder of each draw."""

    folder: Path
    world: BenchmarkWorld
    tasks: Mapping[str, BenchmarkTask]
    files: Mapping[str, Sequence[Path]]

    @property
    def draws(self) -> int:
        """The number of draws of every test clip."""
        return max(map(len, self.files.values()))

    @cached_property
    def coding(self) -> Coding | None:
        """How the videos are coded; None if nothing is lost (PNG, NPZ)."""
        first, *others = [path for paths in self.files.values() for path in paths]
        found = coding_of(first)
        for path in others:
            if coding_of(path) != found:
                raise DataError(
                    f"{path} is {coding_of(path) or 'lossless'}, but {first} is "
                    f"{found or 'lossless'}: submit all predictions of a world in one way"
                )
        return found

    def samples(self) -> Iterator[LossyClip]:
        """All videos with the sizes of their files."""
        for task, paths in self.files.items():
            for draw, path in enumerate(paths):
                yield LossyClip(path.stat().st_size, self.video(task, draw))

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of all files and their names."""
        digest = hashlib.sha256()
        for path in sorted(path for paths in self.files.values() for path in paths):
            for file in sorted(pictures_in(path)) if path.is_dir() else [path]:
                digest.update(f"{path.name}/{file.name}\0{file_sha256(file)}".encode())
        return digest.hexdigest()

    def video(self, task: str, draw: int = 0) -> NDArray[np.float32]:
        """A prediction, `[T, H, W, 3]` in [0, 1].

        Raises:
            DataError: it is not what the task asks for; names the clip.
        """
        return read_whole(self.files[task][draw], task, self.tasks[task].frames, self.world)

    def check(self) -> None:
        """Read every prediction.

        Raises:
            DataError: some are wrong; a sentence for each.
        """
        faults: list[str] = []
        for task, paths in self.files.items():
            for draw in range(len(paths)):
                try:
                    self.video(task, draw)
                except DataError as error:
                    faults.append(str(error))
        _refuse(faults)


def find_predictions(
    folder: Path,
    world: BenchmarkWorld,
    tasks: Sequence[BenchmarkTask],
    *,
    follow_links: bool = False,
) -> Predictions:
    """Find the predictions of a world's tasks below a folder.

    Args:
        folder: where they are, in a folder of the world's name.
        world: the world.
        tasks: its tasks.
        follow_links: whether links may lead out of the folder.

    Raises:
        DataError: one is missing or is there twice, one is of no task, or numbers of draws differ.
    """
    place = folder / world.name if follow_links else inside(folder, world.name)
    wanted = {task.id: task for task in tasks}
    if not place.is_dir():
        raise DataError(
            f"{folder} holds no predictions of {world.name} (no folder {place}): add them, or name "
            "the worlds to score"
        )
    found: dict[str, dict[int, Path]] = {}
    faults: list[str] = []
    for path in sorted(place.iterdir()):
        if path.name.startswith("."):
            continue
        name, draw = _named(path, world.name, wanted)
        if no_file := _no_file(folder, path, follow_links):
            faults.append(no_file)
            if name in wanted:
                found.setdefault(name, {})[draw] = path  # it is not missing
        elif name not in wanted:
            faults.append(f"{path} belongs to no task{suggest(name, wanted)}")
        elif draw in found.setdefault(name, {}):
            faults.append(f"{name}: {found[name][draw].name} and {path.name} both belong to it")
        else:
            found[name][draw] = path
    faults += [f"{name}: its prediction is missing" for name in wanted if name not in found]
    faults += _of_draws(found, wanted)
    _refuse(faults)
    files = {name: [found[name][draw] for draw in sorted(found[name])] for name in wanted}
    return Predictions(folder, world, wanted, files)


def _no_file(folder: Path, path: Path, follow_links: bool) -> str:
    """Why a prediction is no file of its own, nor a folder of such; empty if it is.

    What a link leads to may be another's prediction, and a pipe would be waited for without end.
    """
    try:
        place = path if follow_links else inside(folder, str(path.relative_to(folder)))
        for each in pictures_in(path) if place.is_dir() else [path]:
            if follow_links:
                check_regular(each)
            else:
                regular_file(folder, str(each.relative_to(folder)))
    except (DataError, OSError) as error:
        return str(error)
    return ""


def _named(path: Path, world: str, wanted: Iterable[str]) -> tuple[str, int]:
    """The id of a prediction's file or folder, and the number of its draw."""
    name = path.name
    if not path.is_dir() and path.suffix.lower() in (*CONTAINERS, NPZ):
        name = path.stem
    task = f"{world}/{name}"
    draw = _DRAW.fullmatch(task)
    return (draw[1], int(draw[2])) if draw and task not in wanted else (task, 0)


def _of_draws(
    found: Mapping[str, Mapping[int, Path]], tasks: Mapping[str, BenchmarkTask]
) -> list[str]:
    counts = Counter(len(each) for name, each in found.items() if not tasks[name].branch)
    usual = counts.most_common(1)[0][0] if counts else 1
    wrong = {
        name: sorted(each)
        for name, each in found.items()
        if sorted(each) != list(range(usual)) and not (tasks[name].branch and [*each] == [0])
    }
    return [
        f"{name}: it has the draws {', '.join(map(str, draws))}, but others {usual} from 0 on"
        for name, draws in wrong.items()
    ]


def _refuse(faults: Sequence[str]) -> None:
    if faults:
        more = f"; and {len(faults) - TOLD} more" if len(faults) > TOLD else ""
        raise DataError("; ".join(faults[:TOLD]) + more)
