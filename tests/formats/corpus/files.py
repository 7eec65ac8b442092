"""Folders of videos, and the same videos in the layout of LeRobot 2.1."""

import json

import numpy as np
import pyarrow
import pyarrow.parquet

from tests.formats.corpus import tables
from tests.formats.corpus.clips import write_clip, write_gif, write_images

PICTURES = ("png", "jpg", "webp", "bmp", "tif")


def names(case):
    """The names of the episodes."""
    return case.names or tuple(f"take_{place + 8}" for place in range(len(case.episodes)))


def write_video(folder, name, case, episode):
    """Write the frames of an episode; returns the file or folder."""
    kind = case.clip.suffix
    if kind in PICTURES:
        what = {"grey": "grey", "alpha": "alpha", "depth": "depth"}.get(case.pixels, kind)
        write_images(folder / name, episode.numbers, what, case.size)
        return folder / name
    path = folder / f"{name}.{kind}"
    if kind == "gif":
        write_gif(path, episode.numbers, case.rate, case.size)
    else:
        write_clip(path, episode.numbers, episode.times, case.rate, case.clip, case.size)
    return path


def videos(folder, case):
    """A folder of videos, with a table beside each or one for all."""
    found = []
    for name, episode in zip(names(case), case.episodes, strict=True):
        found.append(write_video(folder, name, case, episode))
        if case.table != "shared":
            write, ending = tables.WRITERS[case.table]
            write(folder / f"{name}.{ending}", episode, case.column)
    if case.table == "shared":
        tables.write_shared(folder / "all.csv", case.episodes, names(case), case.column)
    for place, path in enumerate(found):
        if case.spoil:
            case.spoil(place, path)
    rate = {"rate": float(case.rate)} if case.clip.suffix in PICTURES and not case.column else {}
    return folder, rate


def lerobot(folder, case):
    """The layout of LeRobot 2.1: a file of video and one of rows per episode."""
    camera, height, width = "observation.images.top", *case.size
    for part in ("meta", "data/chunk-000", f"videos/chunk-000/{camera}"):
        (folder / part).mkdir(parents=True)
    features = {
        camera: {"dtype": "video", "shape": [height, width, 3], "names": None},
        "action": {"dtype": "float32", "shape": [2], "names": ["clock", "turn"]},
    }
    info = {
        "codebase_version": "v2.1",
        "fps": float(case.options.get("said", case.rate)),
        "features": features,
        "total_episodes": len(case.episodes),
        "chunks_size": 1000,
        "splits": {},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        ),
    }
    (folder / "meta/info.json").write_text(json.dumps(info))
    lines = []
    for place, episode in enumerate(case.episodes):
        name, length = f"episode_{place:06d}", len(episode.rows)
        clips = folder / f"videos/chunk-000/{camera}"
        path = clips / f"{name}.mp4"
        write_clip(path, episode.numbers, episode.times, case.rate, case.clip, case.size)
        lines.append({"episode_index": place, "tasks": ["turn"], "length": length})
        rows = {
            "action": [list(map(float, row)) for row in episode.rows],
            "timestamp": np.array(episode.row_times, np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, place),
            "index": np.arange(length),
            "task_index": np.zeros(length, np.int64),
        }
        target = folder / f"data/chunk-000/{name}.parquet"
        pyarrow.parquet.write_table(pyarrow.table(rows), target)
        if case.spoil:
            case.spoil(place, path)
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(x) + "\n" for x in lines))
    return folder, {}
