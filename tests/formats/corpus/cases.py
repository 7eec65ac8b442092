"""What a recording of the corpus is, and how those with one property are made."""

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
        numbers: what the frames show; each number is seen once in a case.
        times: when, in seconds.
        rows: the actions; as a rule the first column is the time of its row in seconds.
        row_times: when they were taken.
    """

    numbers: tuple[int, ...]
    times: tuple[Fraction, ...]
    rows: list | np.ndarray
    row_times: tuple[Fraction, ...]

    def row(self, number):
        """The row that is right for a frame: the latest at its time."""
        time = self.times[self.numbers.index(number)]
        return self.rows[max(i for i, taken in enumerate(self.row_times) if taken <= time)]


@dataclass(frozen=True)
class Case:
    """Three episodes; the first has the property that the name says, or all of them.

    Attributes:
        name: the property.
        episodes: what is recorded.
        rate: frames per second.
        size: of the frames as they are to be seen.
        clip: how video files hold them; None if they cannot.
        pixels: how arrays and pictures hold them: a key of `arrays.PIXELS`.
        table: how the actions beside a video are written: a key of `tables.WRITERS`.
        column: the column of the table that says when a row was taken, if there is one.
        spoil: what happens to each file of video afterwards, called with the episode's place.
        options: of the import.
        first: the numbers that the first episode shows at last, if not those that were recorded.
        taken: the places of its rows then; by default the latest at each frame's time.
        answer: the numbers of all episodes, if other episodes come of it.
        told: what the import says about it.
        refused: a word of the sentence by which it is refused instead.
        grey: whether colours are lost.
        depth: whether it is depth, of which what is near is white.
        names: of the videos.
        only: names of the writers that it is for, or beginnings of them; all that can hold it by
            default.
    """

    name: str
    episodes: tuple[Episode, ...]
    rate: Fraction = Fraction(10)
    size: tuple[int, int] = SIZE
    clip: Clip | None = field(default_factory=Clip)
    pixels: str = "rgb"
    table: str = "csv"
    column: str = ""
    spoil: Callable[[int, Path], None] | None = None
    options: Mapping[str, object] = field(default_factory=dict)
    first: tuple[int, ...] | None = None
    taken: tuple[int, ...] | None = None
    answer: tuple[tuple[int, ...], ...] | None = None
    told: str = ""
    refused: str = ""
    grey: bool = False
    depth: bool = False
    names: tuple[str, ...] = ()
    only: tuple[str, ...] = ()

    @property
    def right(self):
        """The numbers and the rows of actions that are right, by episode."""
        recorded = tuple(each.numbers for each in self.episodes)
        shown = self.answer or (self.first or recorded[0], *recorded[1:])
        found = []
        for numbers in shown:
            source = next(each for each in self.episodes if numbers[0] in each.numbers)
            rows = [source.row(number) for number in numbers[:-1]]
            found.append((numbers, rows))
        if self.taken is not None:
            found[0] = (found[0][0], [self.episodes[0].rows[place] for place in self.taken])
        return found


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
    return tuple(episode(40 * place, COUNT + place, **options) for place in range(3))


def peculiar(name, recorded, **options):
    """Three episodes, of which the first is given."""
    return Case(name, (recorded, *three()[1:]), **options)


def rated(rate):
    """Recordings at a rate."""
    return Case(f"rate {float(rate):.4g}", three(rate=rate), Fraction(rate))


def stored_as(name, codec="libx264", pixels="yuv420p", suffix="mp4", *, clip=None, **options):
    """Recordings in a kind of video file."""
    return Case(name, three(), clip=clip or Clip(codec, pixels, suffix), **options)


def pictures(name, suffix, pixels="rgb", **options):
    """Recordings in folders of pictures."""
    return Case(name, three(), clip=Clip(suffix=suffix), pixels=pixels, **options)


def arrays(name, **options):
    """Recordings whose arrays have this kind of pixels."""
    return Case(f"pixels {name}", three(), clip=None, pixels=name, **options)


def acting(name, rows, **options):
    """Recordings with such actions, made of the episode's length."""
    lengths = range(COUNT, COUNT + 3)
    episodes = tuple(episode(40 * i, n, rows=rows(n)) for i, n in enumerate(lengths))
    return Case(f"actions {name}", episodes, **options)


def at(*places):
    """Times at places of a rhythm of 10 per second."""
    return tuple(Fraction(place) / 10 for place in places)


def moments(name, places, rows=None, **options):
    """The first recording has frames at such places of the rhythm, and rows at others."""
    times, row_times = at(*places), at(*(range(int(max(places)) + 1) if rows is None else rows))
    numbers = tuple(range(len(places))) if len({*map(int, places)}) < len(places) else places
    numbers = tuple(map(int, numbers))
    recorded = episode(times=times, numbers=numbers, row_times=row_times)
    return peculiar(name, recorded, **options)
