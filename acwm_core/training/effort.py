"""How much training is behind the weights of a run: its CPU time and what it started from."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback

from acwm_core.training.checkpoints import read_details
from acwm_core.training.run import RunFolder, read_metadata


class CpuTime(Callback):
    """Stores in checkpoints the CPU time of training in seconds, summed over all resumes.

    It is not stored with weights and metrics, which are equal when training is repeated.

    Args:
        init_from: `all_training` of the run whose weights training started from, which is stored
            as well, since that run may be gone or another by the time somebody asks.
    """

    def __init__(self, init_from: dict[str, Any] | None = None) -> None:
        self._before = -time.process_time()
        self._init_from = init_from

    def state_dict(self) -> dict[str, Any]:
        """The CPU time so far, and what training started from."""
        told = {"init_from": self._init_from} if self._init_from else {}
        return {"cpu_seconds": self._before + time.process_time(), **told}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Add the CPU time stored in a checkpoint."""
        self._before += state_dict["cpu_seconds"]
        self._init_from = state_dict.get("init_from")


def training_of(run: RunFolder) -> dict[str, Any]:
    """What `CpuTime` stored: ``cpu_seconds`` and, if there was one, ``init_from``.

    It is empty for a folder without checkpoints; the weights of a trained model hold it instead.
    """
    if not run.last_checkpoint.exists():
        return {}
    return read_details(run.last_checkpoint).get("callbacks", {}).get(CpuTime.__name__, {})


def all_training(name: str, run: RunFolder) -> dict[str, Any]:
    """Sum of all training behind the weights of a run, those it started from included.

    Args:
        name: what the user calls the run; only its last part is kept.

    Returns:
        ``name``, ``step`` and ``cpu_seconds``.
    """
    facts = read_metadata(run.weights) | training_of(run)
    earlier: dict[str, Any] = facts.get("init_from") or {}  # checked when it was read
    sums = {each: facts.get(each, 0) + earlier.get(each, 0) for each in ("step", "cpu_seconds")}
    return {"name": Path(name).name, **sums}
