"""Atomic file writes, and locks that allow one writer per folder or file."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
import re
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import IO

from acwm_core.errors import AcwmError, DataError

PARTIAL, LOCK = ".partial", ".lock"

ENDING_SECONDS = 2.0
"""How long to wait for a killed command to release its folder before refusing."""

OF_THE_DISK = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG),
    errno.ENAMETOOLONG,
)
"""Errors that mean the file cannot be written, whatever its content."""

FULL = re.compile(r"PytorchStreamWriter|inline_container|iostream|\d requested and \d+ written")
"""How PyTorch and NumPy report a full disk, without an error number."""

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of a file system without locks, as on some clusters."""


@contextlib.contextmanager
def written_whole(path: Path) -> Generator[Path]:
    """Yield a temporary path to write to; rename it to `path` once its bytes are on the disk.

    If the block raises, nothing is left behind. If the process dies, a partial file may remain; the
    next writer of `path` on this machine removes it, and so does `remove_partial`.

    Raises:
        OSError: the disk is full or refuses for another reason, whatever exception the library
            that wrote the file made of it.
    """
    begin = f".{path.name}.{socket.gethostname()}-"  # other nodes may share the folder
    partial = path.with_name(f"{begin}{os.getpid()}{PARTIAL}")
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        for left in path.parent.glob(f"{glob.escape(begin)}*{PARTIAL}"):
            if not _runs(left.name[len(begin) : -len(PARTIAL)]):
                left.unlink(missing_ok=True)
        partial.unlink(missing_ok=True)  # it may be a symlink to another place
        partial.touch()
        mode = partial.stat().st_mode  # follows the umask, which some libraries ignore
        yield partial
        partial.chmod(mode)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
        os.fsync(folder)  # so that the rename survives a power cut
    except BaseException as error:
        partial.unlink(missing_ok=True)
        found = disk_error(error)
        if found is not None and found.filename in (None, str(partial)):
            raise OSError(found.errno, found.strerror, str(path)) from error
        raise
    finally:
        os.close(folder)


def _runs(pid: str) -> bool:
    """Whether a process with this id is running here."""
    try:
        os.kill(int(pid), 0)
    except PermissionError:  # it belongs to another user
        return True
    except (ProcessLookupError, OverflowError, ValueError):
        return False
    return True


def disk_error(error: BaseException | None) -> OSError | None:
    """Find the disk error (full, read-only, no permission) behind `error`; libraries wrap it."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in OF_THE_DISK:
            return error
        said = str(error)
        for code in OF_THE_DISK:
            if f"os error {code})" in said or os.strerror(code) in said:
                return OSError(code, os.strerror(code))
        if FULL.search(said):
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        error = error.__cause__ or error.__context__
    return None


@contextlib.contextmanager
def made_whole(folder: Path) -> Generator[Path]:
    """Yield a temporary folder to fill; rename it to `folder` once the block is done.

    Raises:
        DataError: it cannot be written, or another process is making it or has made it meanwhile.
    """
    writable(folder, folder=True)
    partial = folder.with_name(f".{folder.name}{PARTIAL}")
    partial.mkdir(parents=True, exist_ok=True)
    with held(partial, folder):
        made = partial / folder.name
        try:
            shutil.rmtree(made, ignore_errors=True)  # left by a killed process
            made.mkdir(parents=True)
            yield made
            if folder.exists() and any(folder.iterdir()):
                raise DataError(f"another command has made {folder} meanwhile: use that one")
            made.replace(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Turn system errors about writing to `path` into a `DataError`."""
    try:
        yield
    except Exception as error:
        found = disk_error(error) or (error if isinstance(error, OSError) else None)
        if found is None or isinstance(error, AcwmError):
            raise
        raise DataError(
            f"cannot write to {path} ({found.strerror or found}): free disk space or fix the "
            "permissions, and run the same command again to resume"
        ) from error


def writable(path: Path, *, folder: bool = False) -> Path:
    """Return `path` if it can be written. Call it before the work whose result goes there.

    Nothing is created; parent folders may still be missing.

    Args:
        path: a file, which may or may not exist.
        folder: whether `path` is a folder instead.

    Raises:
        DataError: it cannot be written; says why.
    """
    try:
        if path.is_dir() and not folder:
            raise DataError(f"{path} is a folder: name a file in it to write to")
        place = path if folder else path.parent
        while not os.path.lexists(place):
            place = place.parent
        if not place.is_dir():
            raise DataError(f"cannot write {path}: {place} is not a folder; choose another place")
        with tempfile.TemporaryFile(dir=place):  # permissions alone do not tell
            return path
    except OSError as error:
        why = error.strerror or str(error)
        raise DataError(f"{path} cannot be written ({why}): choose another place") from error


def remove_partial(folder: Path, of: str = "") -> None:
    """Remove the partial files that killed writers left in `folder`, or only those of file `of`."""
    for path in folder.glob(f".{of}*{PARTIAL}"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def held(folder: Path, told: Path | None = None) -> Generator[None]:
    """Lock `folder` against other writers; the lock ends with the process, however it ends.

    On Linux the lock also works across nodes if the file system passes locks on, as NFS does. On a
    file system without locks a second writer is not refused and may make the first one fail, but
    files under their final names are complete even then.

    Args:
        told: the folder to name in the message, if it is another one.

    Raises:
        DataError: another process holds the lock.
    """
    with _lock_file(folder / LOCK) as lock:
        patience = time.monotonic() + ENDING_SECONDS
        while not (is_held := _locked(lock, wait=False)) and time.monotonic() < patience:
            time.sleep(0.05)
        if not is_held:
            raise DataError(
                f"another command is writing to {told or folder}; wait for it or choose another "
                "folder"
            )
        yield


@contextlib.contextmanager
def alone(path: Path, *, wait: bool = True) -> Generator[bool]:
    """Be the only process that makes the file `path`; the lock ends with the process.

    Partial files that a killed writer of `path` left are removed.

    Args:
        path: its folder must exist.
        wait: wait until no other process makes it; otherwise yield False at once if one does.

    Yields:
        Whether this process holds the lock. A previous holder may have made the file already.
    """
    with _lock_file(path.with_name(f".{path.name}.lock")) as lock:
        if not _locked(lock, wait):
            yield False
            return
        remove_partial(path.parent, f"{path.name}.")
        yield True


def _lock_file(path: Path) -> IO[bytes]:
    """Open a lock file. It is not changed, and a symlink is refused."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO, errno.EISDIR):
            raise
    else:
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            return file
        file.close()
    raise DataError(f"{path} is not a regular file: remove it")


def _locked(file: IO[bytes], wait: bool) -> bool:
    """Lock an open file, or return False if another process holds the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    return True
