"""Names of pictures of several recordings in one folder, such as ``ep_0_step_0.png``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from acwm_core.errors import DataError

OWNER = (
    r"(?<![a-z])(ep|episode|traj|trajectory|demo|rollout|trial|take|run|seq|sequence|clip)s?[\W_]*"
)
"""What stands before the number of an episode in the names of pictures."""

MOMENT = r"(?<![a-z])(frame|step|timestep|time|t)[\W_]*"
"""What stands before the number of a frame there."""

CAMERA = r"(cam|camera|view|eye)[\W_]*\d+"

STAMP = r"(19|20)\d\d\W?[01]\d\W?[0-3]\d[\W_T]*[0-2]\d\W?[0-5]\d\W?[0-5]\d"
"""A date and time of day, by which the pictures of one recording may be called."""

EPOCH = 10**8
"""What is counted from there on are seconds, and no episodes."""

TWO_NUMBERS = re.compile(r"(.*\D|)(\d+)(\D+)(\d+)(\D*)")
"""The name of a picture up to its last two numbers, the numbers, and what is around the last."""


def numbered(path: Path) -> bool:
    """Whether the name of a picture has two numbers, of which one may be its recording's."""
    return TWO_NUMBERS.fullmatch(path.stem) is not None


def told_apart(folder: Path, paths: Sequence[Path]) -> dict[str, list[int]]:
    """The numbers of the frames of each episode; none if they are one recording's.

    Raises:
        DataError: they are of several, and it is open of which.
    """
    several, owned, restarts = _ways(folder, paths)
    anew = [way for way in several if _is_anew(way)]
    every = [number for numbers in several[0].values() for number in numbers] if several else []
    if len(anew) == 1:
        return anew[0]
    if several and owned and not anew and (np.diff(every) == 1).all():
        return several[0]
    what = f"{folder} has pictures of several recordings, such as {paths[0].name}"
    if anew:
        raise DataError(
            f"{what}, of which either number may be the recording's: call them ep_0_step_0 and so "
            "on, or put those of each into a folder"
        )
    if restarts or (several and owned):
        raise DataError(
            f"{what}, whose frames are not numbered one by one: number them so, or put those of "
            "each into a folder"
        )
    return {}


def _ways(folder: Path, paths: Sequence[Path]) -> tuple[list[dict[str, list[int]]], bool, bool]:
    """How names may be read as those of several episodes.

    Returns:
        The numbers of frames by episode, in none, one or two ways; whether a word such as ``ep``
        says which number is the episode's; and whether numbers begin anew in some way.
    """
    ways: list[dict[str, list[int]]] = [{}, {}]
    for path in paths:
        for way, (key, number) in zip(ways, keys(path), strict=True):
            way.setdefault(key, []).append(number)
    several = [way for way in ways if len(way) > 1 and max(map(len, way.values())) > 1]
    says, owned = _said(paths[0].stem.lower())
    timed = re.search(STAMP, paths[0].stem) or keys(paths[0])[1][1] >= EPOCH
    if not several or (timed and not owned):
        return [], owned, False
    _check_cameras(folder, paths)
    restarts = any(len({numbers[0] for numbers in way.values()}) == 1 for way in several)
    if says[0] != says[1]:
        several = [way for way in several if way is ways[says.index(True)]]
    elif ways[1] in several and not _may_come_last(paths):
        several.remove(ways[1])
    return several, owned, restarts


def _check_cameras(folder: Path, paths: Sequence[Path]) -> None:
    cameras = {match[0] for path in paths if (match := re.search(CAMERA, path.stem.lower()))}
    if len(cameras) > 1:
        raise DataError(f"{folder} has pictures of several cameras: put each into a folder")


def _said(stem: str) -> tuple[list[bool], bool]:
    """Which of two numbers words call an episode's, and whether one such as ``ep`` does."""
    before, _, between, *_ = TWO_NUMBERS.sub(r"\1\n\2\n\3", stem).split("\n")
    owned = [bool(re.search(f"{OWNER}$", part)) for part in (before, between)]
    owned[0] |= bool(re.match(rf"{OWNER}\d", stem))
    moment = [bool(re.search(f"{MOMENT}$", part)) for part in (before, between)]
    says = [owned[0] or (moment[1] and not owned[1]), owned[1] or (moment[0] and not owned[0])]
    return says, any(owned)


def _may_come_last(paths: Sequence[Path]) -> bool:
    """Whether the last of two numbers counts episodes, as far as can be seen, and no time."""
    last = sorted({keys(path)[0][1] for path in paths})
    two = all(len(re.findall(r"\d+", path.stem)) == 2 for path in paths)
    return two and last == [*range(last[0], last[0] + len(last))] and last[0] in (0, 1)


def _is_anew(groups: Mapping[str, list[int]]) -> bool:
    """Whether the frames of each episode are numbered one by one from the same number."""
    first = next(iter(groups.values()))[0]
    return all(numbers == [*range(first, first + len(numbers))] for numbers in groups.values())


def keys(path: Path) -> tuple[tuple[str, int], tuple[str, int]]:
    """What may name the episode of a picture, and the number of its frame: the last, or another."""
    match = TWO_NUMBERS.fullmatch(path.stem)
    if match is None:
        return (path.stem, -1), (path.stem, -1)
    before, first, between, last, end = match.groups()
    return (before + first + between, int(last)), (f"{before}*{between}{last}{end}", int(first))


def title(key: str) -> str:
    """What an episode of pictures is called: the part of their names that has its number."""
    return re.sub(r"^.*\*[\W_]*|\D+$", "", key)
