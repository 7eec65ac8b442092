"""`write_dataset`: write recordings from Python as a data folder that all commands can use."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np

from acwm_core.data.card import DatasetCard
from acwm_core.env.card import plain_rate
from acwm_core.env.environment import ActionSpec, StateField
from acwm_core.env.episode import SPLITS, Split
from acwm_core.errors import AcwmError, DataError, suggest
from acwm_core.files import disk_error
from acwm_formats.alignment import Alignment
from acwm_formats.reading import ImportOptions
from acwm_formats.recordings import import_dataset
from acwm_formats.survey.survey import short_form, survey
from acwm_formats.timeline import (
    ActionFacts,
    RecordedDataset,
    Recording,
    Recordings,
    Samples,
    TimedRecording,
)

__all__ = ["Recording", "write_dataset"]


def write_dataset(
    out: str | Path,
    splits: Mapping[Split, Recordings],
    *,
    name: str,
    action: ActionSpec,
    fps: float | Fraction,
    state: Mapping[str, str] | None = None,
    size: int | tuple[int, int] | None = None,
    summary: str = "",
    alignment: Alignment | None = None,
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
        fps: frames (and so actions) per second, e.g. 30 or ``Fraction(30000, 1001)``.
        state: unit of each array to keep from `Recording.states`, by name; none by default.
        size: frame size, a side or ``(H, W)``; larger frames are averaged down. By default the size
            of the first recording, each side rounded down to a multiple of 8.
        summary: one sentence about the data.
        alignment: what to do about arrays that do not fit together; by default they are refused.
        workers: number of processes to read and encode in; they require picklable `splits`.
        progress: whether to show a progress bar on the terminal, and what was found in the data.

    Returns:
        The card of the folder.

    Raises:
        DataError: a recording is invalid, or the folder holds another dataset.
        ShapeError: the rate or the size is not possible.
    """
    for split in splits:
        if split not in SPLITS:
            raise DataError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    ends = {s: (splits[s][0], splits[s][len(splits[s]) - 1]) for s in splits if len(splits[s])}
    if not ends:
        raise DataError("there are no recordings to write")
    first, rate = next(iter(ends.values()))[0], plain_rate(fps)
    sums = {split: [_digest(recording) for recording in pair] for split, pair in ends.items()}
    recorded = RecordedDataset(
        name,
        splits,
        {"kind": "python", "name": name, "sha256_of_first_and_last": sums},
        fps=rate,
        actions=ActionFacts(action.names, action.units, action.kind, (action.low, action.high)),
        state=tuple(_field(first, field, unit) for field, unit in (state or {}).items()),
        costly=True,
        summary=summary,
    )
    options = ImportOptions(size=size, alignment=alignment or Alignment())
    is_new = not Path(out).exists()
    try:
        card = import_dataset(recorded, out, options, workers=workers, progress=progress)
    except AcwmError as error:
        if is_new and not disk_error(error):  # what was decoded before the disk was full is kept
            shutil.rmtree(out, ignore_errors=True)
        raise
    if progress:
        print(*short_form(survey(out)), sep="\n", file=sys.stderr)
    return card


def _field(recording: Recording | TimedRecording, name: str, unit: str) -> StateField:
    if name not in recording.states:
        raise DataError(f"recordings have no state {name!r}{suggest(name, recording.states)}")
    rows = recording.states[name]
    values = rows.values if isinstance(rows, Samples) else rows
    return StateField(name, np.shape(values)[1:], unit, "as recorded")


def _digest(recording: Recording | TimedRecording) -> str:
    digest = hashlib.sha256()
    if isinstance(recording, Recording):
        for array in (recording.video, recording.actions, *recording.states.values()):
            digest.update(np.ascontiguousarray(array).tobytes())
    else:
        digest.update(np.ascontiguousarray(recording.actions.values).tobytes())
    return digest.hexdigest()
