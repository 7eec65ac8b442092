"""Files that exist either whole or not at all, and folders that one writer holds at a time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
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
"""What a command may take to end after it was killed, until another is refused its folder."""

OF_THE_DISK = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG),
    errno.ENAMETOOLONG,
)
"""What says that a file cannot be written, and nothing of what is to be in it."""

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What a file system without locks says, as some of clusters are mounted."""


@contextlib.contextmanager
def written_whole(path: Path) -> Generator[Path]:
    """Write to the path this yields; it takes its final name once its bytes are on the disk.

    If the block raises, nothing is left behind; if the process dies, only a file that the next
    writer of `path` on this machine removes, and `remove_partial`.

    Raises:
        OSError: the disk is full or refuses otherwise, whatever the library that wrote made of it.
    """
    begin = f".{path.name}.{socket.gethostname()}-"  # other nodes may share the folder
    partial = path.with_name(f"{begin}{os.getpid()}{PARTIAL}")
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        for left in path.parent.glob(f"{glob.escape(begin)}*{PARTIAL}"):
            if not _runs(left.name[len(begin) : -len(PARTIAL)]):
                left.unlink(missing_ok=True)
        partial.unlink(missing_ok=True)  # it may be a link to somewhere else
        partial.touch()
        mode = partial.stat().st_mode  # as the umask has it, which some libraries do not respect
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
    """Whether there is a process of that number on this machine."""
    try:
        os.kill(int(pid), 0)
    except PermissionError:  # somebody else's
        return True
    except (ProcessLookupError, OverflowError, ValueError):
        return False
    return True


def disk_error(error: BaseException | None) -> OSError | None:
    """The refusal of the disk behind an error; libraries tell it in ways of their own."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in OF_THE_DISK:
            return error
        said = str(error)
        for code in OF_THE_DISK:
            if f"os error {code})" in said or os.strerror(code) in said:
                return OSError(code, os.strerror(code))
        if any(sign in said for sign in ("PytorchStreamWriter", "inline_container", "iostream")):
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        error = error.__cause__ or error.__context__
    return None


@contextlib.contextmanager
def made_whole(folder: Path) -> Generator[Path]:
    """Fill the folder that this yields; it takes its final name once the block is done.

    Raises:
        DataError: it cannot be written, or another process makes it, or has done so meanwhile.
    """
    writable(folder, folder=True)
    partial = folder.with_name(f".{folder.name}{PARTIAL}")
    partial.mkdir(parents=True, exist_ok=True)
    with held(partial, folder):
        made = partial / folder.name
        try:
            shutil.rmtree(made, ignore_errors=True)  # of one that was killed
            made.mkdir(parents=True)
            yield made
            if folder.exists() and any(folder.iterdir()):
                raise DataError(f"another command has made {folder} meanwhile: use that one")
            made.replace(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def writing(path: Path) -> Generator[None]:
    """Tell what the system says against writing to `path` as a `DataError`."""
    try:
        yield
    except Exception as error:
        found = error if isinstance(error, OSError) else disk_error(error)
        if found is None or isinstance(error, AcwmError):
            raise
        raise DataError(
            f"cannot write to {path} ({found.strerror or found}): make room or allow it, and run "
            "the same command again to resume"
        ) from error


def writable(path: Path, *, folder: bool = False) -> Path:
    """`path`, if it can be written; to be asked before the work whose result goes there.

    Nothing is made: folders above it may be missing still.

    Args:
        path: a file, there or not.
        folder: it is a folder instead.

    Raises:
        DataError: it cannot, and why.
    """
    try:
        if path.is_dir() and not folder:
            raise DataError(f"{path} is a folder: name a file in it to write to")
        place = path if folder else path.parent
        while not os.path.lexists(place):
            place = place.parent
        if not place.is_dir():
            raise DataError(f"cannot write {path}: {place} is not a folder; choose another place")
        with tempfile.TemporaryFile(dir=place):  # permissions do not tell of all that forbids it
            return path
    except OSError as error:
        why = error.strerror or str(error)
        raise DataError(f"{path} cannot be written ({why}): choose another place") from error


def remove_partial(folder: Path, of: str = "") -> None:
    """Remove what writers that were killed left unfinished in `folder`, or of one file in it."""
    for path in folder.glob(f".{of}*{PARTIAL}"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def held(folder: Path, told: Path | None = None) -> Generator[None]:
    """Hold `folder` against other writers; the hold ends with the process, however it ends.

    On Linux this holds for other nodes too where the file system passes locks on, as NFS does. One
    that knows no locks is not held: a second writer is then not refused and may end the first with
    an error, but what has a final name is whole all the same.

    Raises:
        DataError: another process holds it.
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
    """Be the only process that makes the file `path`; the claim ends with the process.

    What another writer of it left unfinished when it was killed is removed.

    Args:
        path: its folder must exist.
        wait: until nobody else makes it; else yield False at once if somebody does.

    Yields:
        Whether it is this process's turn. The file may be there already, made by the one before.
    """
    with _lock_file(path.with_name(f".{path.name}.lock")) as lock:
        if not _locked(lock, wait):
            yield False
            return
        remove_partial(path.parent, f"{path.name}.")
        yield True


def _lock_file(path: Path) -> IO[bytes]:
    """An open lock file, which is neither followed if it is a link nor changed."""
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
    """Lock an open file, or return False if somebody else has."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    return True
