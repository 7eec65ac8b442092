"""What is wrong with frames: of one colour, repeated, frozen, or blurred."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FLAT = 2.0  # standard deviation of a frame's 256 levels up to which it shows nothing
SAME = 0.01  # mean difference in levels up to which a frame repeats the one before
FROZEN = 10  # frames in a row that repeat each other
SHARP = 0.35  # share of its stretch's median sharpness below which a frame is blurred
EDGES = 0.99  # quantile of a frame's second differences that is its sharpness


@dataclass
class FrameFacts:
    """Counts over the frames that were looked at.

    Attributes:
        frames: how many these are.
        dark: frames that are black.
        flat: frames of one colour other than black.
        repeated: frames that repeat the one before although both neighbours move: a dropped frame
            was filled, or a slow video was stretched.
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
        self, place: tuple[str, int, int], video: NDArray[np.uint8], actions: NDArray[np.float32]
    ) -> None:
        """Count those of a stretch ``[T, 3, H, W]`` that begins at split, episode and frame."""
        split, episode, start = place
        self.frames += len(video)
        for name, marked in _defects(video, actions).items():
            setattr(self, name, getattr(self, name) + int(marked.sum()))
            known = self.examples.setdefault(name, [])
            room = max(0, 3 - len(known))
            known += [(split, episode, start + int(t)) for t in np.flatnonzero(marked)[:room]]


def _defects(
    video: NDArray[np.uint8], actions: NDArray[np.float32]
) -> dict[str, NDArray[np.bool_]]:
    grey = video.mean(1, dtype=np.float32)  # [T, H, W]
    plain = grey.std((1, 2)) <= FLAT
    dark = plain & (grey.mean((1, 2)) < 16)
    still = np.abs(np.diff(grey, axis=0)).mean((1, 2)) <= SAME  # [T − 1]
    acts = np.append(np.abs(np.diff(actions, axis=0)).max(1, initial=0) > 0, False)  # [T − 1]
    frozen = np.zeros(len(video), bool)
    for first, last in _runs(still):
        if last - first >= FROZEN - 1 and acts[first:last].any():
            frozen[first + 1 : last + 1] = True
    alone = np.zeros(len(video), bool)
    alone[2:-1] = still[1:-1] & ~still[:-2] & ~still[2:] & ~plain[2:-1]
    return {
        "dark": dark,
        "flat": plain & ~dark,
        "repeated": alone,
        "frozen": frozen,
        "blurred": _blurred(grey, plain),
    }


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
