"""Logging of training: `metrics.csv`, TensorBoard, a progress bar, and no irrelevant warnings."""

from __future__ import annotations

import csv
import importlib.util
import logging
import os
import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning_pytorch
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from acwm_core.data.atomic import disk_error, written_whole
from acwm_core.errors import MissingExtraError
from acwm_core.training.config import LOGGERS
from acwm_core.training.run import RunFolder

LINE_EVERY_S = 30.0
"""Seconds between progress lines if the output is no terminal and cannot show a bar."""

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


def build_loggers(run: RunFolder, first_step: int, chosen: Sequence[Any] = ()) -> list[Logger]:
    """`metrics.csv` and, unless others are chosen, TensorBoard's event files in the run folder.

    Args:
        first_step: 0, or the step from which a run resumes; entries of an earlier process from
            this step on are dropped from both.
        chosen: the result of `chosen_loggers`.
    """
    if chosen and "tensorboard" not in chosen:
        return [MetricsFile(run.metrics, first_step)]
    board = TensorBoardLogger(
        run.path, "tensorboard", "", default_hp_metric=False, purge_step=first_step or None
    )
    return [MetricsFile(run.metrics, first_step), board]


def classes_of_loggers(chosen: Sequence[Any], run: RunFolder) -> list[Any]:
    """Chosen loggers of Lightning, in the form it takes: `class_path` and `init_args`.

    Loggers chosen by name keep their files in the run folder and name their run after it.

    Raises:
        MissingExtraError: the package of a logger chosen by name is not installed.
    """
    place, name = run.path.resolve(), run.path.resolve().name
    project = os.environ.get("WANDB_PROJECT", "acwm")
    experiment = os.environ.get("MLFLOW_EXPERIMENT_NAME", "acwm")
    presets: dict[str, dict[str, str]] = {
        "wandb": {"save_dir": f"{place}", "name": name, "project": project},
        "mlflow": {"save_dir": f"{place}/mlruns", "run_name": name, "experiment_name": experiment},
    }
    for each in presets.keys() & {*filter(lambda one: isinstance(one, str), chosen)}:
        if importlib.util.find_spec(each) is None:
            install = f"pip install 'acwm[{each}]'"
            raise MissingExtraError(f"trainer.logger={each} needs {each!r}: {install}")
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # MLflow 3 prefers a server
    return [
        {"class_path": f"lightning.pytorch.loggers.{LOGGERS[each]}", "init_args": presets[each]}
        if isinstance(each, str)
        else each
        for each in chosen
        if each not in ("csv", "tensorboard")
    ]


class MetricsFile(Logger):
    """Appends each set of logged numbers as a row of a CSV file.

    The columns are `step` (number of optimiser steps done before) and one per metric; metrics not
    logged in a row are left empty. Lightning's own CSVLogger empties the file when a run is
    resumed.

    Args:
        first_step: rows from this step on are dropped first, because a resumed run repeats them.
    """

    def __init__(self, path: Path, first_step: int = 0) -> None:
        super().__init__()
        self._path, self._first_step = path, first_step
        self._columns = dict[str, None]()

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
        """Do nothing: they are in the run's recipe.yaml."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Append one row."""
        row = {"step": step, **{k: repr(float(v)) for k, v in metrics.items() if k != "epoch"}}
        if len(row) == 1:
            return
        if not row.keys() <= self._columns.keys():
            self._add_columns(row)
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns).writerow(row)

    def _add_columns(self, row: Mapping[str, Any]) -> None:
        rows: list[dict[str, str]] = []
        if self._path.exists():
            with self._path.open(newline="") as file:
                rows = list(csv.DictReader(file))
        if not self._columns:
            whole = (old for old in rows if (old["step"] or "").isdecimal())  # complete rows only
            rows = [old for old in whole if int(old["step"]) < self._first_step]
            self._columns = dict.fromkeys(rows[0] if rows else ())
        self._columns |= dict.fromkeys(row)
        with written_whole(self._path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="")
            writer.writeheader()
            writer.writerows(rows)


class StepProgress(ProgressBar):
    """Shows steps, losses, steps per second and the time left; plain lines in a file or pipe.

    Lightning's own bars count batches of an epoch, which never ends here, and flood log files.
    """

    def __init__(self) -> None:
        super().__init__()
        self._console = Console(stderr=True)
        self._bar = Progress(disable=True)
        self._started_at = self._printed_at = 0.0
        self._first_step = 0

    def disable(self) -> None:
        """Show nothing (used on all ranks but the first)."""
        self._console.quiet = True

    def enable(self) -> None:
        """Show output again."""
        self._console.quiet = False

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Print above the bar."""
        self._console.print(*args, highlight=False, soft_wrap=True)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the bar at the step where training starts or resumes."""
        self._started_at = self._printed_at = time.monotonic()
        self._first_step = trainer.global_step
        trained = sum(p.numel() for p in pl_module.parameters() if p.requires_grad)
        device = trainer.strategy.root_device.type
        threads = f" with {torch.get_num_threads()} threads" if device == "cpu" else ""
        step = f" from step {trainer.global_step}" if trainer.global_step else ""
        self.print(
            f"training {trained / 1e6:.2f} M parameters on {trainer.world_size} × {device}{threads}"
            f"{step} in {trainer.precision}"
        )
        text = "{task.completed}/{task.total} steps  {task.fields[numbers]}"
        columns = (TextColumn("training"), BarColumn(), TextColumn(text), TimeRemainingColumn())
        hidden = self._console.quiet or not self._console.is_terminal
        self._bar = Progress(*columns, console=self._console, disable=hidden)
        total = trainer.max_steps if trainer.max_steps > 0 else None
        self._bar.add_task("training", total=total, completed=trainer.global_step, numbers="")
        self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance."""
        if not self._bar.disable:
            numbers = self._numbers(trainer, pl_module)
            self._bar.update(self._bar.task_ids[0], completed=trainer.global_step, numbers=numbers)
        elif time.monotonic() - self._printed_at > LINE_EVERY_S:
            self._print_line(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the finished bar on the screen."""
        if self._bar.disable:
            self._print_line(trainer, pl_module)
        self._bar.stop()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Stop the bar so that the terminal is usable again."""
        self._bar.stop()

    def _print_line(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._printed_at = time.monotonic()
        of = f"/{trainer.max_steps}" if trainer.max_steps > 0 else ""
        self.print(f"step {trainer.global_step}{of}  {self._numbers(trainer, pl_module)}")

    def _numbers(self, trainer: Trainer, pl_module: LightningModule) -> str:
        elapsed = max(time.monotonic() - self._started_at, 1e-9)
        rate = (trainer.global_step - self._first_step) / elapsed
        metrics = self.get_metrics(trainer, pl_module)
        losses = [f"{k} {v:.4g}" for k, v in metrics.items() if isinstance(v, float)]
        return "  ".join([*losses, f"{rate:.3g} steps/s"])
