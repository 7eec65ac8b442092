"""Replacing a result of several files at once: at any moment it is the old or the new one, whole.

``summary.json`` decides. The other files of a new result wait in a folder that has the hash of
their summary in its name, and count from the moment when that summary takes its final name.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from pathlib import Path

from acwm_core.data.manifest import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.results import SUMMARY, VIDEOS

WAITING = ".result-"


def result_file(folder: Path, name: str) -> Path:
    """Where a file of the result in an evaluation folder is, or would be.

    Args:
        folder: the evaluation folder of a run.
        name: relative to it.
    """
    with contextlib.suppress(DataError):  # no summary
        waiting = _waiting(folder, folder / SUMMARY) / name
        if waiting.exists():
            return waiting
    return folder / name


@contextlib.contextmanager
def replacing_result(folder: Path) -> Generator[Path]:
    """Write a result to the folder that this yields; it replaces the one in `folder` at once.

    The caller holds `folder`. If the block raises, the old result stays.

    Raises:
        OSError: the disk is full or refuses otherwise.
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
    """Move what waits to its final name, and remove what belongs to no result."""
    (folder / VIDEOS).mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(DataError):
        waiting = _waiting(folder, folder / SUMMARY)
        for file in [path for path in waiting.rglob("*") if path.is_file()]:
            file.replace(folder / file.relative_to(waiting))
    for left in folder.glob(f"{WAITING}*"):
        shutil.rmtree(left)
