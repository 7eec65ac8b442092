"""What is wrong with frames: of one colour, repeated, frozen, or blurred.

How much a frame changes is the mean over the block and channel that change most, so that something
small counts like something large. After lossy compression a repeated frame is not quite the same,
and in slow motion the next frame is nearly the same. So a frame is repeated only amid changes that
are clear and much larger; and frames of a frozen stretch are all the same, while slow motion adds
up.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FLAT = 2.0  # standard deviation of a frame's 256 levels up to which it shows nothing
BLOCK = 8  # pixels on a side, of the blocks whose changes are compared
MOVES = 5.0  # change in levels from which something clearly moves
REPEATS = 0.25  # share of the changes before and after up to which a frame repeats the one before
STILL = 2.0  # change in levels that compression makes where nothing moves
SETTLED = 2  # frames after which a frozen video is as sharp as compression makes it
DRIFT = 3.0  # change in levels over a frozen stretch, from when it has settled
FROZEN = 10  # frames in a row that are the same
SHARP = 0.35  # share of its stretch's median sharpness below which a frame is blurred
EDGES = 0.99  # quantile of a frame's second differences that is its sharpness


@dataclass
class FrameFacts:
    """Counts over the frames that were looked at.

    Attributes:
        frames: how many these are.
        dark: frames that are black.
        flat: frames of one colour other than black.
        repeated: frames that repeat the one before amid motion: a dropped frame was filled, or a
            slow video was stretched.
        frozen: frames of at least `FROZEN` in a row that are the same while actions change.
        blurred: frames far less sharp than the others around them.
        examples: the first places of each, by name: split, episode, frame.
    """

    frames: int = 0
    dark: int = 0
    flat: int = 0
    repeated: int = 0
    frozen: int = 0
    blurred: int = 0

    def __post_init__(self) -> None:
        self.examples: dict[str, list[tuple[str, int, int]]] = {}

    def add(
        self,
        place: tuple[str, int, int],
        video: NDArray[np.uint8],
        actions: NDArray[np.float32],
        views: Sequence[str] = (),
    ) -> None:
        """Count those of a stretch ``[T, 3, H, W]`` that begins at split, episode and frame.

        A frame counts if any of its `views`, which stand side by side, is defective.
        """
        split, episode, start = place
        self.frames += len(video)
        parts = np.array_split(video, max(1, len(views)), -1)
        defects = [_defects(part, actions) for part in parts]
        for name in defects[0]:
            defective = np.any([of_view[name] for of_view in defects], axis=0)
            setattr(self, name, getattr(self, name) + int(defective.sum()))
            examples = self.examples.setdefault(name, [])
            room = max(0, 3 - len(examples))
            examples += [(split, episode, start + int(t)) for t in np.flatnonzero(defective)[:room]]


def _defects(
    video: NDArray[np.uint8], actions: NDArray[np.float32]
) -> dict[str, NDArray[np.bool_]]:
    grey = video.mean(1, dtype=np.float32)  # [T, H, W]
    plain = grey.std((1, 2)) <= FLAT
    dark = plain & (grey.mean((1, 2)) < 16)
    changes = np.array([_change(*pair) for pair in itertools.pairwise(video)])  # [T − 1]
    return {
        "dark": dark,
        "flat": plain & ~dark,
        "repeated": _repeated(changes) & ~plain,
        "frozen": _frozen(video, changes, actions),
        "blurred": _blurred(grey, plain),
    }


def _change(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """The change from one frame ``[3, H, W]`` to another, in levels."""
    colours, height, width = one.shape
    side = min(BLOCK, height, width)
    rows, columns = height // side, width // side
    apart = np.abs(other.astype(np.int16) - one)[:, : rows * side, : columns * side]
    return float(apart.reshape(colours, rows, side, columns, side).mean((2, 4)).max())


def _repeated(changes: NDArray[np.float64]) -> NDArray[np.bool_]:
    marked = np.zeros(len(changes) + 1, bool)
    around = np.minimum(changes[:-2], changes[2:])
    marked[2:-1] = (around >= MOVES) & (changes[1:-1] <= REPEATS * around)
    return marked


def _frozen(
    video: NDArray[np.uint8], changes: NDArray[np.float64], actions: NDArray[np.float32]
) -> NDArray[np.bool_]:
    marked = np.zeros(len(video), bool)
    acts = np.append(np.abs(np.diff(actions, axis=0)).max(1, initial=0) > 0, False)  # [T − 1]
    for first, last in [*_runs(changes == 0), *_runs(changes <= STILL)]:
        if last - first < FROZEN - 1 or not acts[first:last].any():
            continue
        settled = video[first + SETTLED]
        if max(_change(settled, frame) for frame in video[first + SETTLED : last + 1]) <= DRIFT:
            marked[first + 1 : last + 1] = True
    return marked


def _runs(marked: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and one past the last index of each run of marked places."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _blurred(grey: NDArray[np.float32], plain: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the sharpest edges of a frame are far less sharp than is usual in its stretch.

    Those alone count: where something small went away, the others are as sharp as before.
    """
    inner = grey[:, 1:-1, 1:-1]
    around = grey[:, :-2, 1:-1] + grey[:, 2:, 1:-1] + grey[:, 1:-1, :-2] + grey[:, 1:-1, 2:]
    second = np.abs(4 * inner - around).reshape(len(grey), -1)
    sharpness = np.quantile(second, EDGES, axis=1)
    return ~plain & (sharpness < SHARP * np.median(sharpness))
