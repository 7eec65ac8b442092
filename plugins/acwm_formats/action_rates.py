"""What an import did to actions of another rate than frames, and what the video follows."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.video import decode_planes
from acwm_core.env.episode import Split
from acwm_formats.alignment import PlannedEpisode
from acwm_formats.reading import CommonReading, opened
from acwm_formats.staging import Staged
from acwm_formats.survey.action_rate import ActionRate, followed
from acwm_formats.survey.following import Moments
from acwm_formats.survey.motion import Floats, small
from acwm_formats.survey.sample import GOLDEN, LENGTH, spread
from acwm_formats.timeline import Recordings

Parts = Mapping[Split, tuple[Recordings, Sequence[int]]]
"""The recordings of each split, and the places in them of those that belong to it."""

SAMPLED = 64  # recordings whose video is examined


def action_rate(
    kept: Sequence[Staged],
    parts: Parts,
    reading: CommonReading,
    folder: Path,
    *,
    again: bool,
) -> ActionRate | None:
    """The rate of the actions of imported recordings; None if every frame has one of its own.

    Args:
        kept: the recordings, with the names of their episodes' files in `folder`.
        parts: where to open them again.
        reading: how they were read.
        again: whether recordings may be opened again, to find out what the video follows.
    """
    others = [file.scan for file in kept if file.scan.unused or file.scan.per_frame != 1]
    if not others:
        return None
    rates = [scan.per_frame for scan in others]
    unused = float(np.median([scan.unused for scan in others]))
    kinds = reading.alignment.kinds
    stated, most = bool(kinds), kinds or ("absolute",)
    rate = ActionRate((min(rates), max(rates)), unused, most, stated)
    if not (rate.is_open and again):
        return rate
    pairs = list(_pairs(kept, parts, reading, folder))
    values, sums = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    follows, shares = followed(values, sums)
    return replace(rate, follows=follows, told=(round(shares[0], 3), round(shares[1], 3)))


def _pairs(
    kept: Sequence[Staged], parts: Parts, reading: CommonReading, folder: Path
) -> Iterator[tuple[Moments, Moments]]:
    """The same stretch with the values at the frames and with the means over them."""
    summing = replace(reading, alignment=replace(reading.alignment, kinds=("velocity",)))
    for order, place in enumerate(spread(len(kept), SAMPLED)):
        scan, files = kept[place]
        recording = opened(parts[scan.split][0], scan.index, scan.name, reading.fps)
        held, summed = reading.planned(recording).episodes, summing.planned(recording).episodes
        index = int(np.argmax([len(episode.actions) for episode in held]))
        both = _common(held[index], summed, reading.cameras[0])
        if both is None:
            continue
        first, values, means = both
        start = int(max(0, len(values) + 1 - LENGTH) * (order * GOLDEN % 1))
        stop = min(len(values), start + LENGTH - 1)
        frames = _frames(folder / files[index], first + start, first + stop + 1)
        episode = scan.split, scan.index
        yield (
            Moments(episode, start, frames, values[start:stop]),
            Moments(episode, start, frames, means[start:stop]),
        )


def _common(
    episode: PlannedEpisode, others: Sequence[PlannedEpisode], camera: str
) -> tuple[int, NDArray[np.float32], NDArray[np.float32]] | None:
    """The first frame that an episode shares with another plan of it, and the actions of both."""
    own = episode.frames[camera]
    for other in others:
        places = np.flatnonzero(own == other.frames[camera][0])
        count = len(other.actions)
        for first in places.tolist():
            if np.array_equal(own[first : first + count], other.frames[camera]):
                rows = slice(first, first + count - 1)
                return first, episode.actions[rows], other.actions[:-1]
    return None


def _frames(path: Path, start: int, stop: int) -> Floats:
    with zipfile.ZipFile(path) as archive:
        return small(decode_planes(archive.read("video.mkv"), start, stop))
