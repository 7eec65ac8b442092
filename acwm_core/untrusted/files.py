"""Plain files, folders without links that lead out of them, and text safe for a terminal."""

from __future__ import annotations

import contextlib
import os
import re
import stat
from pathlib import Path

from acwm_core.errors import DataError

MAX_JSON = 2**26
"""Largest accepted JSON file in bytes; the largest that acwm writes have a few millions."""

STEERING = re.compile(r"[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069]")
"""Characters that control a terminal or the text direction, and unpaired surrogates."""


def printable(text: str) -> str:
    """Replace characters that could control a terminal by `?`."""
    return STEERING.sub("?", text)


def read_bytes(path: Path, at_most: int = MAX_JSON) -> bytes:
    """Read the bytes of a plain file.

    Raises:
        DataError: it is a device, a pipe or a folder, or larger than `at_most` bytes.
        OSError: it does not exist or cannot be read.
    """
    # Non-blocking, so as not to wait for the other end of a pipe.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise DataError(f"{printable(str(path))} is not a regular file: remove it")
        data = file.read(at_most + 1)
    if len(data) > at_most:
        raise DataError(f"{printable(str(path))} has more than the {at_most} bytes it may have")
    return data


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds, at any depth, a link that leads out of it or a special file.

    Call it for every dataset and run before anything in it is read or written.

    Raises:
        DataError: the folder holds such a file; names it.
    """
    home, folders = os.path.realpath(folder), [str(folder)]
    while folders:
        with (
            contextlib.suppress(FileNotFoundError, NotADirectoryError),
            os.scandir(folders.pop()) as entries,
        ):
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.is_symlink():
                    target = os.path.realpath(entry.path)
                    if os.path.commonpath([home, target]) != home:
                        raise DataError(
                            f"{printable(entry.path)} is a link that leads out of {folder}, which "
                            "is not allowed: replace it by what it points to, or remove it"
                        )
                elif not entry.is_file(follow_symlinks=False):
                    raise DataError(f"{printable(entry.path)} is not a regular file: remove it")
