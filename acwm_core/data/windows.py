"""Windows: which clips of fixed length the episodes of a dataset give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError

FRACTION_SEED = 0
"""Of the permutation that `take_fraction` takes episodes by, whatever the seed of a training."""


def window_starts(length: int, frames: int, stride: int) -> range:
    """First frames of the windows of an episode of `length` frames.

    Windows lie inside the episode; one that is shorter than a window gives one, from its start.
    """
    return range(0, max(1, length - frames + 1), stride)


def list_windows(
    lengths: Sequence[int], frames: int, stride: int, episodes: Sequence[int] | None = None
) -> NDArray[np.int64]:
    """Rows ``(episode, first frame)`` of all windows, `[N, 2]`.

    Args:
        lengths: frames of every episode.
        frames: frames of a window.
        stride: frames between the starts of an episode's windows.
        episodes: only these episodes; all by default.
    """
    chosen = range(len(lengths)) if episodes is None else episodes
    rows = [(e, start) for e in chosen for start in window_starts(lengths[e], frames, stride)]
    return np.array(rows, np.int64).reshape(-1, 2)


def hold_out(episodes: int, validation: int | None) -> tuple[range, range]:
    """Split episodes ``0 … episodes − 1`` into those to train on and the last, held out ones.

    Args:
        episodes: how many there are.
        validation: how many to hold out; None for a tenth, at least one and at most 32.

    Raises:
        DataError: nothing would be left to train on.
    """
    if validation is None:
        validation = min(32, max(1, episodes // 10), episodes - 1)
    if validation >= episodes:
        raise DataError(
            f"data.validation_episodes={validation} leaves nothing of {episodes} episodes to "
            "train on: hold out fewer or generate more"
        )
    return range(episodes - validation), range(episodes - validation, episodes)


def take_fraction(episodes: Sequence[int], fraction: float) -> Sequence[int]:
    """A part of `episodes`, in order: always the same, at least one, and nested by `fraction`.

    Which ones a fixed permutation says, as neighbours in a dataset may be alike.
    """
    if fraction == 1:
        return episodes
    count = max(1, round(fraction * len(episodes)))
    order = np.random.Generator(np.random.Philox(FRACTION_SEED)).permutation(len(episodes))
    places: list[int] = np.sort(order[:count]).tolist()
    return [episodes[place] for place in places]


def padded_video(video: NDArray[np.uint8], frames: int) -> NDArray[np.uint8]:
    """`video` ``[T, …]`` with its last frame repeated up to `frames`."""
    missing = frames - len(video)
    return np.concatenate([video, video[-1:].repeat(missing, 0)]) if missing > 0 else video


def window_actions(actions: NDArray[np.float32], start: int, frames: int) -> NDArray[np.float32]:
    """The actions `[frames, A]` within a window; none leads out of it, so the last row is zero."""
    window = np.zeros((frames, actions.shape[1]), np.float32)
    inside = actions[start : start + frames - 1]
    window[: len(inside)] = inside
    return window
