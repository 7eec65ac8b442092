"""Tables of actions beside a video, in every format, written without acwm."""

import csv
import json

import numpy as np
import pyarrow
import pyarrow.parquet

NAMES = ("clock", "turn", "third")


def columns(episode, column):
    """Columns as lists by name, ragged ones included; `column` says when a row was taken."""
    count = max(map(len, episode.rows))
    rows = {
        NAMES[i]: [row[i] if i < len(row) else None for row in episode.rows] for i in range(count)
    }
    return {column: moments(episode, column), **rows} if column else rows


def moments(episode, column):
    """The values of the column that says when a row was taken."""
    if column == "frame":
        return [round(time * 10) for time in episode.row_times]
    unit = {"time_ms": 1000, "stamp_ns": 10**9}.get(column, 1)
    start = 1_700_000_000 if column == "stamp_ns" else 0  # of a clock that counts from 1970
    values = [(start + time) * unit for time in episode.row_times]
    return [int(value) if column == "stamp_ns" else float(value) for value in values]


def write_csv(path, episode, column, delimiter=","):
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow([*([column] if column else []), *NAMES[: len(episode.rows[0])]])
        times = moments(episode, column) if column else [None] * len(episode.rows)
        for time, row in zip(times, episode.rows, strict=True):
            writer.writerow([*([time] if column else []), *row])


def write_semicolons(path, episode, column):
    write_csv(path, episode, column, ";")


def write_npy(path, episode, column):
    np.save(path, np.asarray(episode.rows))


def write_npz(path, episode, column):
    times = {column: np.array(moments(episode, column))} if column else {}
    np.savez(path, actions=np.asarray(episode.rows), **times)


def write_json(path, episode, column):
    path.write_text(json.dumps({n: _plain(v) for n, v in columns(episode, column).items()}))


def write_jsonl(path, episode, column):
    found = {name: _plain(values) for name, values in columns(episode, column).items()}
    rows = (dict(zip(found, row, strict=True)) for row in zip(*found.values(), strict=True))
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))


def write_parquet(path, episode, column):
    table = pyarrow.table({n: pyarrow.array(v) for n, v in columns(episode, column).items()})
    pyarrow.parquet.write_table(table, path)


def write_vectors(path, episode, column):
    table = pyarrow.table({"action": [list(map(float, row)) for row in episode.rows]})
    pyarrow.parquet.write_table(table, path)


def _plain(values):
    return [value.item() if hasattr(value, "item") else value for value in values]


WRITERS = {
    "csv": (write_csv, "csv"),
    "semicolons": (write_semicolons, "csv"),
    "npy": (write_npy, "npy"),
    "npz": (write_npz, "npz"),
    "json": (write_json, "json"),
    "jsonl": (write_jsonl, "jsonl"),
    "parquet": (write_parquet, "parquet"),
    "vectors": (write_vectors, "parquet"),
}
"""How to write a table, and the ending of its file's name."""


def write_shared(path, episodes, names, column):
    """One table for all, with the name of each video in a column."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["episode", *([column] if column else []), *NAMES[:2]])
        for episode, name in zip(episodes, names, strict=True):
            times = moments(episode, column) if column else [None] * len(episode.rows)
            for time, row in zip(times, episode.rows, strict=True):
                writer.writerow([name, *([time] if column else []), *row])
