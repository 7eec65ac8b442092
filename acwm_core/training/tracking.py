"""Loggers that are services, Weights & Biases and MLflow: one run of theirs for each run folder."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import sys
from collections.abc import Generator, Sequence
from typing import Any, cast

from lightning.pytorch import loggers as lightning_loggers
from lightning.pytorch.loggers import MLFlowLogger, WandbLogger
from lightning.pytorch.loggers.logger import Logger

from acwm_core.errors import MissingExtraError, TrainingError
from acwm_core.files import read_json, written_whole
from acwm_core.training.config import LOGGERS
from acwm_core.training.resume import is_first_process
from acwm_core.training.run_folder import RunFolder


def build_tracker(name: str, run: RunFolder) -> Logger:
    """A logger of `LOGGERS` that needs a package; it continues the run that the folder began.

    Raises:
        MissingExtraError: its package is not installed.
        DataError: the folder's file of ids is damaged.
    """
    if importlib.util.find_spec(name) is None:
        install = f"pip install 'acwm[{name}]'"
        raise MissingExtraError(f"trainer.logger={name} needs {name!r}: {install}")
    place, title, begun = run.path.resolve(), run.path.resolve().name, _ids(run).get(name)
    project = os.environ.get("WANDB_PROJECT", "acwm")
    experiment = os.environ.get("MLFLOW_EXPERIMENT_NAME", "acwm")
    settings: dict[str, dict[str, Any]] = {
        "wandb": {"save_dir": f"{place}", "name": title, "project": project, "id": begun},
        "mlflow": {
            **{"save_dir": f"{place}/mlruns", "run_name": title, "run_id": begun},
            "experiment_name": experiment,
        },
    }
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # MLflow 3 prefers a server
    return getattr(lightning_loggers, LOGGERS[name])(**settings[name])


@contextlib.contextmanager
def tracking(loggers: Sequence[Logger], run: RunFolder) -> Generator[list[Logger]]:
    """Begin the runs of services before any work is done, and end those of Weights & Biases.

    Yields:
        The loggers that continue what this folder began; they have the recipe already.

    Raises:
        TrainingError: a service refuses, e.g. because nobody is logged in.
    """
    if not is_first_process():
        yield []
        return
    before, ids, continued = _ids(run), dict[str, str](), list[Logger]()
    is_of_others = getattr(sys.modules.get("wandb"), "run", None) is not None  # as in a sweep
    for logger in loggers:
        for name, kind in (("wandb", WandbLogger), ("mlflow", MLFlowLogger)):
            if isinstance(logger, kind):
                begin(logger)
                ids[name] = str(logger.version)
                if before.get(name) == ids[name]:
                    continued.append(logger)
    if {**before, **ids} != before:
        with written_whole(run.loggers) as partial:
            partial.write_text(json.dumps({**before, **ids}), encoding="utf-8")
    code = 1
    try:
        yield continued
        code = 0
    finally:
        if not is_of_others:
            for logger in loggers:
                if isinstance(logger, WandbLogger):
                    cast(Any, logger).experiment.finish(exit_code=code)


def begin(logger: Logger) -> None:
    """Have a logger begin its run, which it otherwise does when it is first used.

    Raises:
        TrainingError: it cannot.
    """
    try:
        _ = getattr(logger, "experiment", None)
    except Exception as error:
        name, why = type(logger).__name__, " ".join(str(error).split())[:300]
        todo = "choose another trainer.logger"
        if isinstance(logger, WandbLogger):
            todo = (
                "log in with `wandb login`, or set WANDB_MODE=offline and upload the run later "
                "with `wandb sync`"
            )
        raise TrainingError(f"{name} cannot start ({why}): {todo}") from error


def _ids(run: RunFolder) -> dict[str, str]:
    """The ids of the runs that services have of this folder, by the logger's name."""
    return read_json(run.loggers, dict[str, str], "a file of ids") if run.loggers.exists() else {}
