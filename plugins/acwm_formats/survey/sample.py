"""A sample of a dataset: stretches of consecutive frames, spread evenly over its episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Split
from acwm_core.errors import DataError

T = TypeVar("T")

LENGTH = 64  # frames of a stretch, at most
MOST, LEAST = 128, 24  # stretches
PIXELS = 400e6  # of all stretches together; larger frames give fewer stretches
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples spread evenly, however many there are


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames of an episode and the actions between them.

    Attributes:
        split: the split that it is of.
        episode: index of the episode in its split.
        start: index of its first frame in the episode.
        video: ``[T, 3, H, W]`` uint8.
        actions: ``[T − 1, A]``; row i leads from frame i to frame i + 1.
    """

    split: Split
    episode: int
    start: int
    video: NDArray[np.uint8]
    actions: NDArray[np.float32]


@dataclass
class Unread:
    """Episodes that cannot be read: they are left out, and reported.

    Attributes:
        places: split and index of each, and why.
        tried: split and index of all that were tried.
    """

    places: dict[tuple[Split, int], str] = field(default_factory=dict[tuple[Split, int], str])
    tried: set[tuple[Split, int]] = field(default_factory=set[tuple[Split, int]])

    def read(self, split: Split, index: int, how: Callable[[], T]) -> list[T]:
        """What `how` reads of an episode; nothing if it cannot be read."""
        self.tried.add((split, index))
        try:
            return [how()]
        except DataError as error:
            self.places.setdefault((split, index), str(error))
            return []


def spread(count: int, most: int) -> list[int]:
    """At most `most` of the indices 0 … `count` − 1, evenly spread."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()


def all_places(lengths: Mapping[Split, list[int]]) -> list[tuple[Split, int]]:
    """Split and index of every episode."""
    return [(split, index) for split, part in lengths.items() for index in range(len(part))]


def stretches(data: Mapping[Split, EpisodeDataset], unread: Unread) -> Iterator[Stretch]:
    """Read stretches one by one, so that one is in memory at a time."""
    places = all_places({split: dataset.lengths for split, dataset in data.items()})
    height, width = next(iter(data.values())).card.environment.frame_size
    most = int(np.clip(PIXELS / (LENGTH * height * width), LEAST, MOST))
    chosen = spread(len(places), most)
    for order, place in enumerate(chosen):
        split, index = places[place]
        length = data[split].lengths[index]
        for start in _starts(length, most // len(chosen), order):
            stop = min(length, start + LENGTH)
            window = split, index, start, stop
            yield from unread.read(split, index, lambda w=window: _stretch(data, *w))


def _stretch(
    data: Mapping[Split, EpisodeDataset], split: Split, index: int, start: int, stop: int
) -> Stretch:
    video = data[split].video(index, start, stop)
    actions = data[split].actions(index)[start : stop - 1]
    return Stretch(split, index, start, video, actions)


def _starts(length: int, wanted: int, order: int) -> list[int]:
    """First frames of stretches that do not overlap; one alone is not always at the beginning."""
    room = max(0, length - LENGTH)
    if wanted < 2 or length < 2 * LENGTH:
        return [int(room * (order * GOLDEN % 1))]
    return np.linspace(0, room, min(wanted, length // LENGTH)).astype(int).tolist()
