"""The recordings: what each holds, what is peculiar about it, and what is right."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import numpy as np

from tests.formats.corpus.clips import Clip
from tests.formats.corpus.pictures import SIZE

NTSC = Fraction(30000, 1001)
COUNT = 8


@dataclass(frozen=True)
class Episode:
    """What a camera and a clock saw.

    Attributes:
        numbers: what the frames show.
        times: when, in seconds.
        rows: the actions; the first column is the time of its row in seconds.
        row_times: when they were taken; those of the frames by default.
    """

    numbers: tuple[int, ...]
    times: tuple[Fraction, ...]
    rows: list | np.ndarray
    row_times: tuple[Fraction, ...]


@dataclass(frozen=True)
class Case:
    """Recordings with one property.

    Attributes:
        name: the property.
        episodes: what is recorded.
        rate: frames per second.
        size: of the frames as they are to be seen.
        clip: how video files hold them; None if they cannot.
        pixels: how arrays and images hold them: a key of `arrays.PIXELS`.
        table: the format of the actions beside a video, a key of `tables.WRITERS`.
        timed: whether the table has a column of times.
        spoil: what happens to the files afterwards, called with the path of each episode.
        options: of the import.
        answer: the numbers that each imported episode shows; those of the episodes by default.
        refused: a word of the sentence by which it is refused instead.
    """

    name: str
    episodes: tuple[Episode, ...]
    rate: Fraction = Fraction(10)
    size: tuple[int, int] = SIZE
    clip: Clip | None = field(default_factory=Clip)
    pixels: str = "rgb"
    table: str = "csv"
    timed: bool = False
    spoil: Callable[[int, Path], None] | None = None
    options: Mapping[str, object] = field(default_factory=dict)
    answer: tuple[tuple[int, ...], ...] | None = None
    refused: str = ""
    names: tuple[str, ...] = ()

    @property
    def right(self):
        """The numbers that are right, by episode."""
        return self.answer or tuple(episode.numbers for episode in self.episodes)


def episode(first=0, count=COUNT, rate=10, *, times=None, numbers=None, rows=None, row_times=None):
    """Frames that show first, first + 1, …, one per 1 / rate, and a row of actions for each."""
    times = times or tuple(Fraction(k) / Fraction(rate) for k in range(count))
    numbers = numbers or tuple(range(first, first + len(times)))
    row_times = row_times or times
    if rows is None:
        rows = np.array([[float(t), k % 3 - 1] for k, t in enumerate(row_times)], np.float32)
    return Episode(numbers, times, rows, row_times)


def three(**options):
    """Three episodes, one behind the other in number."""
    return tuple(episode(20 * place, COUNT + place, **options) for place in range(3))


def rated(rate, **options):
    """Recordings at a rate."""
    return Case(f"rate {float(rate):.4g}", three(rate=rate), Fraction(rate), **options)


def stored_as(name, clip, **options):
    """Recordings in a kind of video file."""
    return Case(name, three(), clip=clip, **options)
