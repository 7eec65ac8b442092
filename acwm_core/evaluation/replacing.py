"""Replaces a result of several files atomically: readers see the whole old or whole new result.

``summary.json`` decides which. The other files of a new result wait in a folder whose name holds
the hash of their summary. They become valid at the moment that summary gets its final name.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from pathlib import Path

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.results import SUMMARY, VIDEOS

WAITING = ".result-"


def result_file(folder: Path, name: str) -> Path:
    """The path where a file of the current result is, or would be.

    Args:
        folder: the evaluation folder of a run.
        name: path of the file relative to `folder`.
    """
    with contextlib.suppress(DataError):  # no summary
        waiting = _waiting(folder, folder / SUMMARY) / name
        if waiting.exists():
            return waiting
    return folder / name


@contextlib.contextmanager
def replacing_result(folder: Path) -> Generator[Path]:
    """Yield a folder to write a result to; afterwards it replaces the one in `folder` atomically.

    The caller must hold the lock of `folder`. If the block raises, the old result stays.

    Raises:
        OSError: the disk is full or not writable.
    """
    _settle(folder)
    new = folder / f"{WAITING}new"
    try:
        (new / VIDEOS).mkdir(parents=True)
        yield new
        waiting = _waiting(folder, new / SUMMARY)
        new.replace(waiting)
        (waiting / SUMMARY).replace(folder / SUMMARY)
    finally:
        _settle(folder)


def _waiting(folder: Path, summary: Path) -> Path:
    return folder / f"{WAITING}{file_sha256(summary)}"


def _settle(folder: Path) -> None:
    """Move waiting files to their final names, and remove files that belong to no result."""
    (folder / VIDEOS).mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(DataError):
        waiting = _waiting(folder, folder / SUMMARY)
        for file in [path for path in waiting.rglob("*") if path.is_file()]:
            file.replace(folder / file.relative_to(waiting))
    for left in folder.glob(f"{WAITING}*"):
        shutil.rmtree(left)
