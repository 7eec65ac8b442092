"""Plays the episodes that a folder of results lacks, for `acwm plan` and for `acwm rank`."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence

import torch

from acwm_core.executors import progress_bar
from acwm_core.training.threads import use_threads
from acwm_planning.left_out import LeftOut, passed_over
from acwm_planning.resumable import Line, ResumableResults


class EpisodeTable(ABC):
    """A table of episodes: its rows are controllers or policies, its columns seeds.

    Attributes:
        rows: names of the rows.
        left: what failed, and is left out.
    """

    def __init__(self, rows: Sequence[str]) -> None:
        self.rows, self.left = rows, LeftOut()

    @abstractmethod
    def lines(self, seed: int, rows: Sequence[str]) -> Iterable[Line]:
        """Results for some of the rows from the start of a seed, without those that fail."""

    @abstractmethod
    def estimate(self, missing: Mapping[int, Sequence[str]]) -> str:
        """How long it takes to play these rows, by seed, in words; empty if it takes little."""


def missing_rows(
    rows: Sequence[str], seeds: Sequence[int], results: ResumableResults
) -> dict[int, list[str]]:
    """Rows still to be played, for each seed that lacks some."""
    row_key, seed_key = results.keys
    finished = {(line[row_key], line[seed_key]) for line in results.finished()}
    missing = {seed: [row for row in rows if (row, seed) not in finished] for seed in seeds}
    return {seed: names for seed, names in missing.items() if names}


def play_missing(
    table: EpisodeTable,
    results: ResumableResults,
    seeds: Sequence[int],
    *,
    report: Callable[[Line], None] = lambda line: None,
    progress: str = "",
) -> None:
    """Play what is missing in a folder, seed by seed, so that a partial table compares all rows.

    Args:
        table: plays the episodes.
        results: keeps a line for each of them; the caller holds its folder.
        seeds: numbers of the episodes.
        report: called with each line once it is kept.
        progress: label of a progress bar, which an estimate of the time precedes; none by default.

    Raises:
        Exception: every episode failed; the first of their errors.
    """
    missing = missing_rows(table.rows, seeds, results)
    total, count = len(seeds) * len(table.rows), sum(map(len, missing.values()))
    threads = torch.get_num_threads()
    try:
        if progress and missing:
            _use_idle_cores(threads)
            with passed_over():
                if estimate := table.estimate(missing):
                    print(estimate, file=sys.stderr, flush=True)
        with progress_bar(progress, total, done=total - count, shown=bool(progress)) as advance:
            for seed, rows in missing.items():
                _use_idle_cores(threads)
                with table.left.trying("everything", seed):
                    for line in table.lines(seed, rows):
                        results.add(line)
                        report(line)
                advance(len(rows))
    finally:
        torch.set_num_threads(threads)
    if table.left.error and not results.finished():
        raise table.left.error


def _use_idle_cores(most: int) -> None:
    """Use as many of torch's threads, at most `most`, as there are idle cores, unless users say.

    Two threads that wait for each other beside another program decide three to ten times as slowly
    as one, and other programs come and go while a table is played.
    """
    torch.set_num_threads(most)
    use_threads(None, None, choose=True)
