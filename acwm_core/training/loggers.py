"""Logging of training: `metrics.csv`, TensorBoard, other loggers, and no irrelevant warnings."""

from __future__ import annotations

import csv
import logging
import os
import threading
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning_pytorch
from lightning.pytorch import loggers as lightning_loggers
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from acwm_core.files import disk_error, written_whole
from acwm_core.training.config import LOGGERS, chosen_loggers
from acwm_core.training.run_folder import RunFolder
from acwm_core.training.tracking import build_tracker

IRRELEVANT = (
    r".*does not have many workers.*",  # decoding is cheap or cached; data.workers sets the number
    r".*module\(s\) in eval mode at the start of training.*",  # intended: codec and average
    r".*Checkpoint directory .* exists and is not empty.*",  # the run was resumed
    r".*callbacks used to create the checkpoint need to be provided.*",  # from trainer.max_time
    r".*`srun` command is available.*",
    r".*Starting from v1\.9\.0, `tensorboardX`.*",
    r".*isinstance\(treespec, LeafSpec\).*",  # torch's pytree, used inside lightning
    r".*`torch\.distributed\.reduce_op` is deprecated.*",
    r".*weights_only.*",
    r".*The `lightning` package.*",
    r".*Total length of `list` across ranks is zero.*",  # data.validation_episodes=0
    r".*defined a `validation_step` but have no `val_dataloader`.*",  # the same
    r".*find_unused_parameters=True was specified.*",
    r".*assuming the intent is to load in a single process.*",  # this is the intent
    r".*Dynamo detected a call to a `functools.lru_cache`.*",  # harmless: cached functions are pure
)
"""Patterns of warnings about things that are intended."""


SPEED = "speed/"
"""Prefix of metrics that differ when training is repeated; `metrics.csv` does without them."""


def silence_irrelevant_warnings() -> None:
    """Silence tips and warnings that users of acwm cannot act on; errors stay visible."""
    for name in (lightning_pytorch.__name__, "lightning.fabric"):  # their import sets levels, too
        logging.getLogger(name).setLevel(logging.WARNING)
    logging.getLogger("torch.distributed").setLevel(logging.ERROR)
    for message in IRRELEVANT:
        warnings.filterwarnings("ignore", message=message)
    # A full disk ends TensorBoard's thread; training then fails when it next logs something.
    threading.excepthook = lambda raised: (
        None if disk_error(raised.exc_value) else threading.__excepthook__(raised)
    )


def build_loggers(run: RunFolder, flags: Mapping[str, Any], first_step: int) -> list[Logger]:
    """`metrics.csv`, and the loggers that `trainer.logger` names; TensorBoard if it chooses none.

    Loggers keep their files in the run folder and name their run after it; a resumed run continues
    theirs.

    Args:
        flags: the section `trainer` of the recipe.
        first_step: 0, or the step from which a run resumes; entries of an earlier process from
            this step on are dropped.

    Raises:
        MissingExtraError: the package of a logger chosen by name is not installed.
    """
    chosen = chosen_loggers(flags)
    loggers: list[Logger] = [MetricsFile(run.metrics, first_step)]
    if not chosen or "tensorboard" in chosen:
        board = lightning_loggers.TensorBoardLogger(
            run.path, "tensorboard", "", default_hp_metric=False, purge_step=first_step or None
        )
        loggers.append(board)
    named = [logger for logger in chosen if isinstance(logger, str) and LOGGERS[logger]]
    return [*loggers, *(build_tracker(name, run) for name in named)]


class MetricsFile(Logger):
    """Appends each set of logged numbers as a row of a CSV file.

    The columns are `step` (number of optimiser steps done before) and one per metric; metrics not
    logged in a row are left empty. Lightning's `CSVLogger` empties the file when a run is resumed.

    Args:
        first_step: rows from this step on are dropped first, because a resumed run repeats them.
    """

    def __init__(self, path: Path, first_step: int = 0) -> None:
        super().__init__()
        self._path, self._first_step = path, first_step
        self._columns: list[str] = []

    @property
    def name(self) -> str:
        """Not used: the file has one fixed place."""
        return ""

    @property
    def version(self) -> str:
        """Not used."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: they are in the run's recipe.yaml."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Append one row."""
        kept = {k: v for k, v in metrics.items() if k != "epoch" and not k.startswith(SPEED)}
        row = {"step": step, **{k: repr(float(v)) for k, v in kept.items()}}
        if len(row) == 1:
            return
        if not row.keys() <= {*self._columns}:
            self._add_columns(row)
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns).writerow(row)

    def _add_columns(self, row: Iterable[str]) -> None:
        """Write the file again, row by row, with columns for all of `row`."""
        is_first = not self._columns  # an earlier process wrote what the file has
        old = self._path if self._path.exists() else Path(os.devnull)
        with old.open(newline="") as before, written_whole(self._path) as partial:
            rows = csv.DictReader(before)
            self._columns = [*dict.fromkeys([*(rows.fieldnames or ()), *row])]
            with partial.open("w", newline="") as after:
                writer = csv.DictWriter(after, self._columns, restval="")
                writer.writeheader()
                writer.writerows(row for row in rows if not is_first or self._is_before(row))

    def _is_before(self, row: Mapping[str, str]) -> bool:
        """Whether a row has its step, and it is one before the first."""
        step = row.get("step", "")
        return step.isdecimal() and int(step) < self._first_step
