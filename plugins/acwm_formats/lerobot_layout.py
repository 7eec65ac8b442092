"""LeRobot's dataset format on disk: version 3.0, and 2.x for reading.

meta/info.json                               features, frame rate, splits, path templates
meta/episodes/chunk-000/file-000.parquet     3.0: the location of each episode
meta/episodes.jsonl                          2.x: the length of each episode
data/chunk-000/file-000.parquet              a row per frame, many episodes
videos/CAMERA/chunk-000/file-000.mp4         many episodes one after another
"""

from __future__ import annotations

import importlib
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from acwm_core.data.shards import UNREADABLE
from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import DataError
from acwm_core.files import check_fetched, parse_json
from acwm_formats.tables import parquet_file, read_parquet
from acwm_formats.texts import Fact, text_facts

arrow: Any = importlib.import_module("pyarrow")  # it has no type annotations
parquet: Any = importlib.import_module("pyarrow.parquet")

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
CARD = "meta/acwm.json"  # card of the environment, only if acwm wrote the dataset
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES_PATH = f"meta/episodes/{FILE}.parquet"
DATA_PATH = f"data/{FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{FILE}.mp4"
CHUNK_FILES = 1000
DATA_MB, VIDEO_MB = 100, 200
"""Sizes in MB at which a new file is begun."""

ACTION = "action"
COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns of every row besides the recorded features."""


class Shown(NamedTuple):
    """Where the frames of an episode lie.

    Attributes:
        path: the video file.
        start: at which second of it the episode starts.
        end: and ends; None if that is not stated.
    """

    path: Path
    start: float = 0.0
    end: float | None = None


class EpisodeFiles(NamedTuple):
    """The location of one episode.

    Attributes:
        episode: number of the episode.
        length: number of its frames.
        data: the parquet file with its rows.
        videos: for each camera whose frames are not in the rows, where these are.
        tasks: what was to be done.
        texts: what else the index of episodes says of it in words.
    """

    episode: int
    length: int
    data: Path
    videos: dict[str, Shown]
    tasks: tuple[str, ...] = ()
    texts: Mapping[str, Fact] = {}


def read_info(root: Path) -> dict[str, Any]:
    """Read ``meta/info.json`` and check the entries that every version has.

    Raises:
        DataError: it is missing or damaged, or of a version that cannot be read.
    """
    path = root / INFO
    info = _json(path)
    version = info.get("codebase_version")
    if version not in (VERSION, "v2.0", "v2.1"):
        raise DataError(f"{path} is of LeRobot's version {version}; 2.0, 2.1 and 3.0 can be read")
    features, fps = info.get("features"), info.get("fps")
    if not isinstance(features, dict) or not isinstance(fps, int | float) or not 1e-5 < fps < 1e6:
        raise DataError(f"{path} has no features or no fps")
    for name, feature in cast(dict[str, Any], features).items():
        if not isinstance(feature, dict):
            raise DataError(f"{path} says of the feature {name} only {feature!r:.40}: no dtype")
    return info


def read_card(root: Path) -> EnvironmentCard | None:
    """Read the card of the environment, if acwm wrote the dataset.

    Raises:
        DataError: it is damaged.
    """
    if not (root / CARD).exists():
        return None
    try:
        return EnvironmentCard.from_dict(_json(root / CARD))
    except (AttributeError, *UNREADABLE) as error:
        raise DataError(f"{root / CARD} is not a card ({type(error).__name__}: {error})") from error


def read_places(root: Path) -> list[EpisodeFiles]:
    """Read the location of every episode, in order of their numbers, which may have gaps.

    Raises:
        DataError: the location of an episode is missing, damaged or leads out of `root`.
    """
    info = read_info(root)
    filmed = [n for n, feature in info["features"].items() if feature.get("dtype") == "video"]
    rows = _rows(root) if info["codebase_version"] == VERSION else _old_rows(root, info)
    try:
        places = [_place(root, info, filmed, row) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise DataError(
            f"{root / 'meta'} does not say where its episodes are ({reason})"
        ) from error
    places.sort(key=lambda place: place.episode)
    for one, other in itertools.pairwise(places):
        if one.episode == other.episode:
            raise DataError(f"{root / 'meta'} has episode {one.episode} twice")
    return places


def read_columns(path: Path, names: list[str], episode: int) -> Any:
    """Read columns of an episode from a parquet file, as a table in frame order.

    Raises:
        DataError: the file is missing or damaged, or has no such column.
    """
    order = ["episode_index", "frame_index"]
    check_fetched(path)
    try:
        columns = list(dict.fromkeys([*order, *names]))
        table = read_parquet(path, columns, ("episode_index", episode))
        return table.sort_by([(name, "ascending") for name in order]).select(names)
    except (OSError, LookupError, ValueError, arrow.ArrowException) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> DataError:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return DataError(f"{path} cannot be read ({reason})")


def _rows(root: Path) -> list[dict[str, Any]]:
    paths = sorted((root / "meta" / "episodes").glob("[!.]*/[!.]*.parquet"))
    if not paths:
        raise DataError(f"{root} has no meta/episodes: it is not a complete LeRobot dataset")
    rows: list[dict[str, Any]] = []
    for path in paths:
        check_fetched(path)
        try:
            with parquet_file(path) as file:
                names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
            rows += read_parquet(path, names).to_pylist()
        except (OSError, ValueError, arrow.ArrowException) as error:
            raise _unreadable(path, error) from error
    return rows


def _old_rows(root: Path, info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The episodes in the index of version 2, where each episode has its own files."""
    path = root / "meta" / "episodes.jsonl"
    check_fetched(path)
    try:
        rows = [parse_json(line) for line in path.read_bytes().splitlines()]
        return [{**row, "chunk": row["episode_index"] // info["chunks_size"]} for row in rows]
    except (OSError, ValueError, KeyError, TypeError, ArithmeticError) as error:
        raise DataError(f"{path} cannot be read ({type(error).__name__}: {error})") from error


def _place(
    root: Path, info: Mapping[str, Any], filmed: Sequence[str], row: Mapping[str, Any]
) -> EpisodeFiles:
    episode, length = int(row["episode_index"]), int(row["length"])
    tasks = tuple(map(str, row.get("tasks") or ()))
    texts = text_facts(
        {n: v if isinstance(v, list) else [v] for n, v in row.items() if n != "tasks"}
    )
    videos: dict[str, Shown] = {}
    if "chunk" in row:  # version 2
        names = {"episode_chunk": row["chunk"], "episode_index": episode}
        for camera in filmed:
            path = _path(root, info["video_path"], {**names, "video_key": camera})
            videos[camera] = Shown(path)
        return EpisodeFiles(
            episode, length, _path(root, info["data_path"], names), videos, tasks, texts
        )

    def numbers(prefix: str) -> dict[str, Any]:
        return {key: int(row[f"{prefix}/{key}"]) for key in ("chunk_index", "file_index")}

    for camera in filmed:
        key = f"videos/{camera}"
        path = _path(root, info["video_path"], {**numbers(key), "video_key": camera})
        end = row.get(f"{key}/to_timestamp")
        start = float(row[f"{key}/from_timestamp"])
        videos[camera] = Shown(path, start, None if end is None else float(end))
    return EpisodeFiles(
        episode, length, _path(root, info["data_path"], numbers("data")), videos, tasks, texts
    )


def _path(root: Path, template: str, names: Mapping[str, Any]) -> Path:
    """Fill in a template such as `DATA_PATH`.

    It does not use `str.format`, which lets a template access attributes of the values or ask for
    gigabytes.
    """

    def value(match: re.Match[str]) -> str:
        given = names[match[1]]
        return f"{given:0{match[2]}d}" if match[2] else str(given)

    name = Path(re.sub(r"\{(\w+)(?::0(\d)d)?\}", value, template))
    if name.is_absolute() or ".." in name.parts:
        raise DataError(f"{root / name} leads out of {root}, which is not allowed")
    return root / name


def _json(path: Path) -> dict[str, Any]:
    check_fetched(path)
    try:
        content = parse_json(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path} is missing: {path.parents[1]} is not a LeRobot dataset") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({type(error).__name__}: {error})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} is not a JSON object")
    return cast(dict[str, Any], content)
