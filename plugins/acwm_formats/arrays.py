"""`write_dataset`: write recordings from Python as a data folder that all commands can use."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acwm_core.data.card import DatasetCard
from acwm_core.env.environment import ActionSpec, StateField
from acwm_core.env.episode import SPLITS, Split
from acwm_core.errors import DataError, suggest
from acwm_formats.recordings import (
    RecordedDataset,
    Recording,
    Recordings,
    import_dataset,
    recorded_card,
)
from acwm_formats.video import shrunk, target_size

__all__ = ["Recording", "write_dataset"]


def write_dataset(
    out: str | Path,
    splits: Mapping[Split, Recordings],
    *,
    name: str,
    action: ActionSpec,
    fps: int,
    state: Mapping[str, str] | None = None,
    size: int | tuple[int, int] | None = None,
    summary: str = "",
    workers: int = 0,
    progress: bool = True,
) -> DatasetCard:
    """Write your own recordings as a data folder that all commands can use.

    Args:
        out: the folder; created with its parents.
        splits: recordings by split: a list of `Recording`, or an object with ``__len__`` and
            ``__getitem__`` that reads each one on demand.
        name: name of the environment that they show, one word.
        action: names, units and bounds of the action.
        fps: frames (and so actions) per second.
        state: unit of each array to keep from `Recording.states`, by name; none by default.
        size: frame size, a side or ``(H, W)``; larger frames are averaged down. By default the size
            of the first recording, each side rounded down to a multiple of 8.
        summary: one sentence about the data.
        workers: number of processes to read and encode in; they require picklable `splits`.
        progress: whether to show a progress bar on the terminal.

    Returns:
        The card of the folder.

    Raises:
        DataError: a recording is invalid, or the folder holds another dataset.
    """
    for split in splits:
        if split not in SPLITS:
            raise DataError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    ends = {s: (splits[s][0], splits[s][len(splits[s]) - 1]) for s in splits if len(splits[s])}
    if not ends:
        raise DataError("there are no recordings to write")
    first = next(iter(ends.values()))[0]
    card = recorded_card(
        name,
        action,
        frame_size=target_size((first.video.shape[1], first.video.shape[2]), size),
        fps=fps,
        horizon=max(recording.frames for pair in ends.values() for recording in pair),
        state=[_field(first, field, unit) for field, unit in (state or {}).items()],
        summary=summary,
    )
    sums = {split: [_digest(recording) for recording in pair] for split, pair in ends.items()}
    facts = {"kind": "python", "name": name, "sha256_of_first_and_last": sums}
    recorded = RecordedDataset(
        card, {split: _Shrunk(splits[split], card.frame_size) for split in splits}, facts
    )
    return import_dataset(recorded, out, workers=workers, progress=progress)


def _field(recording: Recording, name: str, unit: str) -> StateField:
    if name not in recording.states:
        raise DataError(f"recordings have no state {name!r}{suggest(name, recording.states)}")
    return StateField(name, np.asarray(recording.states[name]).shape[1:], unit, "as recorded")


def _digest(recording: Recording) -> str:
    digest = hashlib.sha256()
    for array in (recording.video, recording.actions, *recording.states.values()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class _Shrunk:
    """Recordings whose frames are averaged down to `size`."""

    recordings: Recordings
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.recordings)

    def __getitem__(self, index: int) -> Recording:
        recording = self.recordings[index]
        if recording.video.shape[1:3] == self.size:
            return recording
        return replace(recording, video=shrunk(recording.video, self.size))
