"""Where a run's numbers go: `metrics.csv` and TensorBoard, both continued by a resumed run."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from acwm_core.data.atomic import written_whole
from acwm_core.training.run import RunFolder


class MetricsFile(Logger):
    """Appends every logged set of numbers as a row of one CSV file.

    The columns are `step` (optimiser steps done before) and one per metric; what was not logged
    together is left empty. Lightning's own CSVLogger empties the file when a run is resumed.

    Args:
        path: the file; a resumed run goes on in it.
        first_step: rows from this step on are dropped first, because a resumed run repeats them.
    """

    def __init__(self, path: Path, first_step: int = 0) -> None:
        super().__init__()
        self._path = path
        self._first_step = first_step
        self._columns: list[str] | None = None

    @property
    def name(self) -> str:
        """Not used: the file has one fixed place."""
        return ""

    @property
    def version(self) -> str:
        """Not used: the file has one fixed place."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: they are in the run's recipe.yaml."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Append one row."""
        row = {"step": step, **{k: repr(float(v)) for k, v in metrics.items() if k != "epoch"}}
        if len(row) == 1:
            return
        if self._columns is None:
            self._start()
        new = [name for name in row if name not in (self._columns or [])]
        if new:
            self._rewrite(self._read(), [*(self._columns or []), *new])
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns or []).writerow(row)

    def _start(self) -> None:
        rows = [row for row in self._read() if int(row["step"]) < self._first_step]
        self._rewrite(rows, list(rows[0]) if rows else ["step"])

    def _read(self) -> list[dict[str, str]]:
        if not self._path.exists():
            return []
        with self._path.open(newline="") as file:
            return list(csv.DictReader(file))

    def _rewrite(self, rows: list[dict[str, str]], columns: list[str]) -> None:
        self._columns = columns
        with written_whole(self._path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="")
            writer.writeheader()
            writer.writerows(rows)


def build_loggers(run: RunFolder, first_step: int) -> list[Logger]:
    """`metrics.csv` and TensorBoard's event files in the run folder.

    Args:
        run: the run folder.
        first_step: 0, or the step at which a resumed run goes on; what an earlier process logged
            from there on is dropped from both.
    """
    board = TensorBoardLogger(
        run.path,
        name="tensorboard",
        version="",
        default_hp_metric=False,
        purge_step=first_step or None,
    )
    return [MetricsFile(run.metrics, first_step), board]
