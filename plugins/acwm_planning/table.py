"""The table of a task: episodes of every row on the same seeds, kept as they are finished."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from acwm_core.data.atomic import writing, written_whole
from acwm_core.errors import DataError
from acwm_core.statistics import CONFIDENCE, Estimate
from acwm_core.statistics.bootstrap import with_interval
from acwm_core.untrusted import parse_json

ROWS = ("model", "simulator", "codec", "solution", "policy", "random", "still")
"""Who acts: the planner with the model; the same planner with the simulator in its place; that,
seen through codec and estimator; the scripted solution of the task; the behaviour policy; random
actions; nobody."""

EPISODES, SETTINGS, SUMMARY, FILMS = "episodes.jsonl", "settings.json", "summary.json", "films"
"""Files in the folder of a table."""

Line = Mapping[str, Any]
"""A finished episode: its ``row``, its ``seed``, and `Played.facts`."""


@dataclass(frozen=True)
class Results:
    """The folder of a table, to which finished episodes are added one by one.

    Args:
        folder: which is made.
        settings: what decides the results; the folder holds those of one setting alone.

    Raises:
        DataError: it holds results of other settings, or cannot be written.
    """

    folder: Path
    settings: Mapping[str, Any]

    def __post_init__(self) -> None:
        asked, path = json.loads(json.dumps(self.settings)), self.folder / SETTINGS
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if not path.exists():
                with written_whole(path) as partial:
                    partial.write_text(json.dumps(asked, indent=1), encoding="utf-8")
        found: dict[str, Any] = parse_json(path.read_text(encoding="utf-8"))
        other = sorted(name for name in {*asked, *found} if asked.get(name) != found.get(name))
        if other:
            raise DataError(
                f"{self.folder} holds results of another {', '.join(other)}: choose another --out, "
                "or delete it"
            )

    def finished(self) -> list[Line]:
        """All episodes; a line that was cut off while it was written does not count."""
        path, found = self.folder / EPISODES, dict[tuple[str, int], Line]()
        for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                line: dict[str, Any] = parse_json(text)
                found[str(line["row"]), int(line["seed"])] = line
            except (ValueError, KeyError, TypeError, DataError):
                continue
        return list(found.values())

    def add(self, line: Line) -> None:
        """Keep an episode at once; what was cut off before it ends with its line."""
        path = self.folder / EPISODES
        with writing(path), path.open("a+b") as file:
            if file.tell() and path.read_bytes()[-1:] != b"\n":
                file.write(b"\n")
            file.write(json.dumps(line, allow_nan=False).encode() + b"\n")

    def write_summary(self, summary: Mapping[str, Any]) -> Path:
        """Write the table."""
        path = self.folder / SUMMARY
        with writing(path), written_whole(path) as partial:
            partial.write_text(json.dumps(summary, indent=1), encoding="utf-8")
        return path


@dataclass(frozen=True)
class RowSummary:
    """One row of the table."""

    row: str
    episodes: int
    successes: int
    success: Estimate  # share, with its exact interval (Clopper and Pearson 1934)
    failures: int
    distance: Estimate  # mean final distance, with its bootstrap interval
    start_distance: float  # mean
    # of the difference in successes from the first row, on seeds that both have; None if it is it
    p: float | None
    seconds_per_decision: float | None
    rollouts_per_decision: float | None


def summarise(lines: Sequence[Line]) -> list[RowSummary]:
    """A row for each that has episodes, in the order of `ROWS`."""
    by_row = {row: {n["seed"]: n for n in lines if n["row"] == row} for row in ROWS}
    there = [row for row in ROWS if by_row[row]]
    return [_row(row, by_row[row], by_row[there[0]]) for row in there]


def _row(row: str, lines: Mapping[int, Line], first: Mapping[int, Line]) -> RowSummary:
    made = list(lines.values())
    successes = sum(bool(line["success"]) for line in made)
    interval = binomtest(successes, len(made)).proportion_ci(CONFIDENCE, "exact")
    distances = np.array([line["distance"] for line in made], float)

    def mean(name: str) -> float | None:
        values = [line[name] for line in made if name in line]
        return float(np.mean(values)) if values else None

    return RowSummary(
        row=row,
        episodes=len(made),
        successes=successes,
        success=Estimate(successes / len(made), float(interval.low), float(interval.high)),
        failures=sum(bool(line["failed"]) for line in made),
        distance=with_interval(float(distances.mean()), [distances]),
        start_distance=float(np.mean([line["start_distance"] for line in made])),
        p=None if lines is first else mcnemar(first, lines),
        seconds_per_decision=mean("seconds_per_decision"),
        rollouts_per_decision=mean("rollouts_per_decision"),
    )


def mcnemar(one: Mapping[int, Line], other: Mapping[int, Line]) -> float:
    """McNemar's exact test: p of so uneven successes on the seeds of both by chance, two-sided."""
    pairs = [(bool(one[n]["success"]), bool(other[n]["success"])) for n in one if n in other]
    better, worse = pairs.count((True, False)), pairs.count((False, True))
    return float(binomtest(better, better + worse).pvalue) if better + worse else 1.0


def left(
    rows: Sequence[str], seeds: Sequence[int], done: Sequence[Line]
) -> Iterator[tuple[str, int]]:
    """What is to be played still, seed by seed, so that a table can be looked at any time."""
    finished = {(line["row"], line["seed"]) for line in done}
    for seed in seeds:
        yield from ((row, seed) for row in rows if (row, seed) not in finished)
