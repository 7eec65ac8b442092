"""Windows: which clips the episodes of a dataset give."""

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


def clip_lengths(
    windows: NDArray[np.int64], lengths: Sequence[int], frames: int, temporal_stride: int | None
) -> NDArray[np.int64]:
    """Frames of each clip, `[N]`: of an episode that is shorter than a window, what there is of it.

    Such a clip is cut to whole latent frames, and to two of them at least: one to start from and
    one to predict. Only what an episode lacks for these two is made up by repeating its last frame.

    Args:
        windows: rows ``(episode, first frame)``.
        lengths: frames of every episode.
        frames: frames of a window.
        temporal_stride: video frames per latent frame; None for clips of `frames` always.
    """
    if temporal_stride is None:
        return np.full(len(windows), frames)
    held = np.asarray(lengths, np.int64)[windows[:, 0]] - windows[:, 1]
    latent_steps = np.maximum(1, (held - 1) // temporal_stride)
    return np.where(held < frames, np.minimum(frames, 1 + temporal_stride * latent_steps), frames)


def common_length(lengths: NDArray[np.int64], indices: Sequence[int]) -> int:
    """Frames of the clips `indices`.

    Raises:
        ValueError: they are of several lengths, which no batch can hold.
    """
    found = lengths[np.asarray(indices)]
    if (found != found[0]).any():
        raise ValueError(f"a batch cannot hold clips of {sorted(set(found.tolist()))} frames")
    return int(found[0])


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
