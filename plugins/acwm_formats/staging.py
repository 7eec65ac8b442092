"""Episodes that are decoded and encoded, kept in a folder until all of them are known.

So an import goes on after it was killed, after a bad file was removed, and with other options as
far as they change nothing: each episode is kept under what identifies it. The numbers and shards of
episodes are given out only when it is known which recordings are sound.
"""

from __future__ import annotations

import functools
import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.arrays import from_npy, to_npy, to_npz
from acwm_core.data.shards import Packed, joined
from acwm_core.data.video import KEYFRAMES, MASK, VIDEO, encode_frames
from acwm_core.env.card import ActionSpec
from acwm_core.env.episode import EpisodeSpec, Split
from acwm_core.errors import DataError
from acwm_core.executors import Report
from acwm_core.files import disk_error, writing, written_whole
from acwm_formats.alignment import PlannedEpisode
from acwm_formats.frames import file_stamp
from acwm_formats.reading import CommonReading, Scan, episode_name, opened, scanned
from acwm_formats.timeline import Recordings, TimedRecording

STAGING = ".importing"
"""Folder in a data folder that is being filled by an import."""

ORDER = "episodes.json"
"""File in it: the staged files of each split, in their order."""


@dataclass(frozen=True)
class StageTask:
    """Recordings of one split to decode."""

    recordings: Recordings
    split: Split
    indices: tuple[int, ...]
    reading: CommonReading
    fps: float
    versions: Mapping[str, str]
    folder: Path
    sampled: int


class Staged(NamedTuple):
    """A recording whose episodes are in the folder: their files, and what was seen on the way."""

    scan: Scan
    files: tuple[str, ...]


def stage(task: StageTask, report: Report) -> list[Staged]:
    """Decode the episodes of recordings into the folder, but those that are there; reports each.

    Raises:
        DataError: the folder cannot be written.
    """
    staged: list[Staged] = []
    for index in task.indices:
        staged.append(_recording(task, index))
        report(1)
    return staged


def _recording(task: StageTask, index: int) -> Staged:
    name = episode_name(task.split, index)
    files: list[str] = []
    try:
        recording = opened(task.recordings, index, name, task.reading.fps)
        aligned = task.reading.planned(recording)
        name = recording.name
        for episode in aligned.episodes:
            files.append(_staged(task, recording, episode))
    except (DataError, OSError) as error:
        full = disk_error(error)
        if full and full.filename and Path(full.filename).parent == task.folder:
            raise  # it is no defect of this recording
        scan = Scan.of_defect(task.split, index, name, str(error))
        return Staged(scan, ())
    return Staged(scanned(task.split, index, aligned, task.sampled, ()), tuple(files))


def _staged(task: StageTask, recording: TimedRecording, episode: PlannedEpisode) -> str:
    """The name of the file of an episode, which is made if it is not there."""
    reading = task.reading
    stamps = [recording.cameras[name].stamp for name in reading.cameras]
    labels = recording.labels if reading.instances else None
    about = repr((reading.key(recording, episode), stamps, task.fps, sorted(task.versions.items())))
    about += repr(reading.instances) if labels else ""
    path = task.folder / f"{hashlib.sha256(about.encode()).hexdigest()[:32]}.zip"
    if path.exists():
        return path.name
    frames, count = reading.frames(recording, episode), len(episode.actions)
    size = (reading.size[0], reading.size[1] * len(reading.cameras))
    masks, contacts = _no_masks(count, size, task.fps), np.zeros((0, 3), np.int32)
    if labels:
        places = episode.frames[reading.cameras[0]]
        contacts = labels.contacts_of(places)
        masks = encode_frames(labels.masks_of(places, size), size, MASK, task.fps, count)
    members = {
        "video.mkv": encode_frames(frames, size, VIDEO, task.fps, KEYFRAMES),
        "mask.mkv": masks,
        "actions.npy": to_npy(episode.actions),
        "states.npz": to_npz(episode.states),
        "contacts.npy": to_npy(contacts),
        "facts.json": json.dumps(dict(recording.facts)).encode(),
    }
    with writing(path), written_whole(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path.name


@functools.lru_cache(maxsize=64)  # most recordings are of a few lengths
def _no_masks(count: int, size: tuple[int, int], fps: float) -> bytes:
    return encode_frames([np.zeros(size, np.uint8)] * count, size, MASK, fps, count)


@dataclass(frozen=True)
class StagedEpisodes:
    """Gives the staged episodes to the shards; see `acwm_core.data.generate.fill`.

    Attributes:
        folder: where they are, with `ORDER`.
        action: bounds, to which actions are cut.
        versions: of the packages, for every episode.
    """

    folder: Path
    action: ActionSpec
    versions: Mapping[str, str]

    def __call__(self, specs: Sequence[EpisodeSpec]) -> Iterator[Packed]:
        """Yield the episodes of `specs`."""
        for spec in specs:
            order = self.folder / ORDER
            name = _order(order, file_stamp(order))[spec.split][spec.index]
            with zipfile.ZipFile(self.folder / name) as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
            facts = json.loads(members.pop("facts.json"))
            actions = from_npy(members["actions.npy"])
            actions[:-1] = cut(actions[:-1], self.action)
            members["actions.npy"] = to_npy(actions)
            yield joined(spec, actions, members, self.versions, {}, None, facts)


def cut(actions: NDArray[np.float32], spec: ActionSpec) -> NDArray[np.float32]:
    """Actions within the bounds."""
    return np.clip(actions, np.array(spec.low, np.float32), np.array(spec.high, np.float32))


@functools.lru_cache(maxsize=1)
def _order(path: Path, _: str) -> dict[str, list[str]]:
    return json.loads(path.read_bytes())
