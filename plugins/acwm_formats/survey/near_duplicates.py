"""Episodes of different splits that are nearly the same: what a test would not test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Split
from acwm_formats.survey.motion import small
from acwm_formats.survey.sample import Unread, spread

EPISODES = 2000  # most episodes of a split that are compared
NEAR = 3 / 255  # largest difference of two small frames that are the same
ALIKE = 0.02  # largest difference of two actions that are the same, in standard deviations


@dataclass(frozen=True)
class NearDuplicate:
    """A test episode and the training episode that it nearly equals."""

    split: Split
    episode: int
    trained: int


@dataclass(frozen=True)
class _Print:
    """What an episode is recognised by: small frames, and actions at these moments."""

    frames: NDArray[np.uint8]
    actions: NDArray[np.float32]


def near_duplicates(
    data: Mapping[Split, EpisodeDataset], unread: Unread
) -> tuple[list[NearDuplicate], int]:
    """Find test episodes that equal training episodes; also returns how many were compared."""
    if "train" not in data or len(data) == 1:
        return [], 0

    def prints(split: Split) -> Iterator[tuple[int, _Print]]:
        for index in spread(len(data[split]), EPISODES):
            for fingerprint in unread.read(split, index, lambda i=index: _print(data[split], i)):
                yield index, fingerprint

    train = dict(prints("train"))
    if not train:
        return [], 0
    frames = np.stack([fingerprint.frames for fingerprint in train.values()])
    actions = np.stack([fingerprint.actions for fingerprint in train.values()])
    scale = actions.reshape(-1, actions.shape[-1]).std(0) + 1e-9
    duplicates: list[NearDuplicate] = []
    count = 0
    tests: list[Split] = [split for split in data if split != "train"]
    for split in tests:
        for index, fingerprint in prints(split):
            count += 1
            apart = np.abs(actions - fingerprint.actions).max(1) / scale
            for place in np.flatnonzero((apart <= ALIKE).all(-1)):
                gap = np.abs(frames[place].astype(np.int16) - fingerprint.frames).max()
                if gap <= NEAR * 255:
                    duplicates.append(NearDuplicate(split, index, list(train)[int(place)]))
                    break
    return duplicates, count


def _print(data: EpisodeDataset, index: int) -> _Print:
    """Take frames at a tenth, half and nine tenths; the first ones are often the same."""
    length = data.lengths[index]
    moments = [int(share * (length - 1)) for share in (0.1, 0.5, 0.9)]
    frames = np.concatenate([small(data.video(index, t, t + 1)) for t in moments])
    rows = data.actions(index)[[max(0, min(t, length - 2)) for t in moments]]
    return _Print((frames * 255).round().astype(np.uint8), rows)
