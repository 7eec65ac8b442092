"""Writes LeRobot datasets of version 3.0, directly with pyarrow and PyAV."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard, StateField
from acwm_core.env.episode import Episode
from acwm_formats.lerobot_layout import (
    ACTION,
    CARD,
    CHUNK_FILES,
    DATA_MB,
    DATA_PATH,
    EPISODES_PATH,
    INFO,
    STATS,
    TASKS,
    VERSION,
    VIDEO_MB,
    VIDEO_PATH,
    arrow,
    parquet,
)
from acwm_formats.statistics import Stats, colour_statistics, combined, plain, statistics
from acwm_formats.video_writer import VideoWriter

CAMERA = "observation.images.main"
STATE = "observation.state"
OWN = "observation.states."  # prefix of state fields that are separate features
SHORT = 64  # state fields of at most this many numbers are joined to one vector


class _Rolling:
    """Numbers files of one kind, and says when to begin the next one."""

    def __init__(self, root: Path, template: str, max_mb: int, **names: str) -> None:
        self._root, self._template, self._names = root, template, names
        self._max, self._number = max_mb * 2**20, -1

    def next(self) -> Path:
        """The path of the next file; its folder is created."""
        self._number += 1
        path = self._root / self._template.format(**self.place, **self._names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def full(self, size: int) -> bool:
        """Whether a file of `size` bytes has reached its limit."""
        return size >= self._max

    @property
    def place(self) -> dict[str, int]:
        """`chunk_index` and `file_index` of the current file."""
        chunk, file = divmod(self._number, CHUNK_FILES)
        return {"chunk_index": chunk, "file_index": file}


class Writer:
    """Writes rows, video and index of a LeRobot dataset, episode by episode.

    Attributes:
        episodes: the index of those that were added.
    """

    def __init__(self, root: Path, card: EnvironmentCard) -> None:
        self._root, self._card, self._features = root, card, _features(card)
        rows = {name: entry for name, entry in self._features.items() if name != CAMERA}
        self._schema = arrow.schema([(name, _type(entry)) for name, entry in rows.items()])
        self._data = _Rolling(root, DATA_PATH, DATA_MB)
        self._videos = _Rolling(root, VIDEO_PATH, VIDEO_MB, video_key=CAMERA)
        self._rows_file: Any = None
        self._video: VideoWriter | None = None
        self._bytes = self._frames = 0
        self._total: dict[str, Stats] = {}
        self.episodes: list[dict[str, Any]] = []

    def add(self, episode: Episode) -> None:
        """Append an episode."""
        number, length = len(self.episodes), len(episode.video)
        columns = _columns(episode, self._card, number, self._frames)
        start = self._write_video(episode.video)
        self._write_rows(columns)
        stats = {name: statistics(rows) for name, rows in columns.items()}
        stats[CAMERA] = colour_statistics(episode.video)
        for name, part in stats.items():
            total = self._total.get(name)
            self._total[name] = combined([total, part]) if total else part
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self._card.summary],
            "length": length,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + length,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        row |= {f"data/{key}": value for key, value in self._data.place.items()}
        row |= {f"videos/{CAMERA}/{key}": value for key, value in self._videos.place.items()}
        row[f"videos/{CAMERA}/from_timestamp"] = start / self._card.fps
        row[f"videos/{CAMERA}/to_timestamp"] = (start + length) / self._card.fps
        public = {name: part for name, part in stats.items() if not name.startswith(OWN)}
        for feature, values in plain(public).items():
            row |= {f"stats/{feature}/{name}": value for name, value in values.items()}
        self.episodes.append(row)
        self._frames += length

    def close(self, splits: Mapping[str, str]) -> None:
        """Finish the files and write the folder `meta`."""
        if self._video:
            self._video.close()
        if self._rows_file:
            self._rows_file.close()
        path = self._root / EPISODES_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        parquet.write_table(arrow.Table.from_pylist(self.episodes), path)
        parquet.write_table(_tasks(self._card.summary), self._root / TASKS)
        _write_json(self._root / STATS, plain(self._total))
        _write_json(self._root / INFO, self._info(splits))
        _write_json(self._root / CARD, self._card.to_dict())

    def _write_video(self, video: NDArray[np.uint8]) -> int:
        """Add an episode to the video; returns the index of its first frame in the file."""
        if self._video and self._videos.full(self._video.bytes):
            self._video.close()
            self._video = None
        if self._video is None:
            self._video = VideoWriter(self._videos.next(), self._card.frame_size, self._card.fps)
        start = self._video.frames
        self._video.add(video)
        return start

    def _write_rows(self, columns: Mapping[str, NDArray[Any]]) -> None:
        if self._rows_file and self._data.full(self._bytes):
            self._rows_file.close()
            self._rows_file, self._bytes = None, 0
        if self._rows_file is None:
            self._rows_file = parquet.ParquetWriter(self._data.next(), self._schema)
        arrays = [_array(columns[field.name], field.type) for field in self._schema]
        table = arrow.Table.from_arrays(arrays, schema=self._schema)
        self._rows_file.write_table(table)
        self._bytes += table.nbytes

    def _info(self, splits: Mapping[str, str]) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self._card.name,
            "total_episodes": len(self.episodes),
            "total_frames": self._frames,
            "total_tasks": 1,
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self._card.fps,
            "splits": dict(splits),
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": self._features,
        }


def _short(card: EnvironmentCard) -> list[StateField]:
    return [field for field in card.state if np.prod(field.shape, dtype=int) <= SHORT]


def _features(card: EnvironmentCard) -> dict[str, dict[str, Any]]:
    """The features in ``meta/info.json``: every column and the camera."""
    height, width = card.frame_size
    about = {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.is_depth_map": False,
        "video.fps": card.fps,
        "video.channels": 3,
        "has_audio": False,
    }
    axes = ["height", "width", "channels"]
    features: dict[str, dict[str, Any]] = {
        CAMERA: {"dtype": "video", "shape": [height, width, 3], "names": axes, "info": about},
        ACTION: _vector(list(card.action.names)),
    }
    short = _short(card)
    names = [entry for field in short for entry in _entries(field)]
    if names:
        features[STATE] = _vector(names)
    for field in card.state:
        if field not in short:
            features[_own(field)] = _vector(_entries(field))
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return features


def _own(field: StateField) -> str:
    return f"{OWN}{field.name}"


def _vector(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def _entries(field: StateField) -> list[str]:
    """A name for each number of a field: ``position``, or ``position.0``, ``position.1`` …"""
    indices = np.ndindex(*field.shape)
    return [".".join([field.name, *map(str, index)]) for index in indices]


def _columns(
    episode: Episode, card: EnvironmentCard, number: int, first: int
) -> dict[str, NDArray[Any]]:
    """The rows of an episode: a column per feature except the camera; vectors are ``[T, n]``."""
    length, short = len(episode.video), _short(card)
    rows = {f.name: np.asarray(episode.states[f.name], np.float32) for f in card.state}
    flat = {name: values.reshape(length, -1) for name, values in rows.items()}
    columns: dict[str, NDArray[Any]] = {ACTION: episode.actions}
    if short:
        columns[STATE] = np.concatenate([flat[field.name] for field in short], axis=1)
    columns |= {_own(field): flat[field.name] for field in card.state if field not in short}
    frames = np.arange(length)
    columns["timestamp"] = (frames / card.fps).astype(np.float32)
    columns["frame_index"], columns["index"] = frames, frames + first
    columns["episode_index"] = np.full(length, number)
    columns["task_index"] = np.zeros(length, np.int64)
    return columns


def _type(feature: Mapping[str, Any]) -> Any:
    """The Arrow type of a column; LeRobot stores a vector with one entry as a number."""
    number = arrow.type_for_alias(feature["dtype"])
    (size,) = feature["shape"]
    return number if size == 1 else arrow.list_(number, size)


def _array(rows: NDArray[Any], kind: Any) -> Any:
    flat = arrow.array(np.ascontiguousarray(rows).reshape(-1))
    if not arrow.types.is_fixed_size_list(kind):
        return flat.cast(kind)
    return arrow.FixedSizeListArray.from_arrays(flat, kind.list_size)


def _tasks(task: str) -> Any:
    """A table of one task that pandas reads with the task as index, as LeRobot requires."""
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": n, "field_name": n, "pandas_type": p, "numpy_type": t, "metadata": None}
        for n, (p, t) in kinds.items()
    ]
    index = {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}
    about = {
        "index_columns": ["task"],
        "column_indexes": [{**index, "metadata": {"encoding": "UTF-8"}}],
        "columns": columns,
        "creator": {"library": "pyarrow", "version": arrow.__version__},
        "pandas_version": "2.0.0",
    }
    table = arrow.table({"task_index": [0], "task": [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")
