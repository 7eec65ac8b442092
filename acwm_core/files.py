"""Files and folders: written whole, by one command at a time, and read without running anything."""

from __future__ import annotations

import contextlib
import copy
import errno
import functools
import glob
import json
import os
import re
import shutil
import socket
import stat
import tempfile
import time
import warnings
import zipfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

from acwm_core.errors import AcwmError, AcwmWarning, DataError

T = TypeVar("T")

PARTIAL, LOCK = ".partial", ".lock"

CACHE = "ACWM_CACHE"
"""Environment variable for the folder of `cache_folder`."""

ENDING_SECONDS = 2.0
"""How long to wait for a killed command to release its folder before refusing."""

NOTICE_SECONDS = 20.0
"""How long to wait for another process before saying whom this one waits for."""

OF_THE_DISK = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG),
    *(errno.ENAMETOOLONG, errno.ENOTDIR),
)
"""Errors that mean the file cannot be written, whatever its content."""

FULL = 2**20
"""Free bytes below which a disk is full, where a library fails to write without an error number."""

MOST_VALUES = 1_000_000
"""Most values that a YAML file may hold, with those that its aliases repeat."""

KEPT_TEXT = 20_000
"""Most characters of a YAML file whose content is kept for the next time that it is read."""

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""How a file begins that Git LFS puts in the place of one that it has not fetched."""

_NOT_FETCHED = "is a pointer of Git LFS and not the file itself: run `git lfs pull` there"

_NAME = re.compile(r"\w[\w .+-]{0,199}")

NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP)
"""Errors of a file system without locks, as on some clusters."""


def cache_folder() -> Path:
    """The folder in which acwm keeps what it can make again; not made yet.

    It is `$ACWM_CACHE`, else ``acwm`` in the user's cache folder, else, where the user has no home
    that can be written to, as in some containers, a folder of the user's own in that of temporary
    files.
    """
    import platformdirs

    if chosen := os.environ.get(CACHE):
        return Path(chosen)
    with contextlib.suppress(RuntimeError):  # a user without an account has no home
        usual = platformdirs.user_cache_path("acwm")
        if usual.is_absolute() and is_writable(usual):
            return usual
    own = Path(tempfile.gettempdir(), f"acwm-{os.getuid()}")
    own.mkdir(mode=0o700, exist_ok=True)
    status = own.lstat()
    if status.st_uid != os.getuid() or not stat.S_ISDIR(status.st_mode):  # it could be anybody's
        raise DataError(f"{own} belongs to another user: set {CACHE} to a folder for acwm's cache")
    return own


def is_writable(folder: Path) -> bool:
    """Whether files can be written into `folder`, or into the folder where it would be made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


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
    for left in path.parent.glob(f"{glob.escape(begin)}*{PARTIAL}"):
        if not _runs(left.name[len(begin) : -len(PARTIAL)]):
            left.unlink(missing_ok=True)
    try:
        partial.unlink(missing_ok=True)  # it may be a link to another place
        partial.touch()
        mode = partial.stat().st_mode  # follows the umask, which some libraries ignore
        yield partial
        partial.chmod(mode)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException as error:
        is_full = shutil.disk_usage(path.parent).free < FULL
        partial.unlink(missing_ok=True)
        cause = disk_error(error)
        if cause is None and is_full and isinstance(error, Exception):
            cause = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if cause is not None and cause.filename in (None, str(partial)):
            raise OSError(cause.errno, cause.strerror, str(path)) from error
        raise


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
        inner = partial / folder.name
        try:
            shutil.rmtree(inner, ignore_errors=True)  # left by a killed process
            inner.mkdir(parents=True)
            yield inner
            if folder.exists() and any(folder.iterdir()):
                raise DataError(
                    f"another command has created {folder} in the meantime: use that one"
                )
            inner.replace(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def writing(path: Path, instead: str = "") -> Generator[None]:
    """Turn system errors about writing to `path` into a `DataError`.

    Args:
        path: what is written.
        instead: a phrase that says what to do without it.
    """
    try:
        yield
    except Exception as error:
        cause = disk_error(error) or (error if isinstance(error, OSError) else None)
        if cause is None or isinstance(error, AcwmError):
            raise
        raise DataError(
            f"cannot write to {path} ({cause.strerror or cause}): free disk space or fix the "
            f"permissions, and run the same command again to resume{', ' * bool(instead)}{instead}"
        ) from error


def writable(path: Path, *, folder: bool = False, option: str = "") -> Path:
    """Return `path` if it can be written. Call it before the work whose result goes there.

    Nothing is created; parent folders may still be missing.

    Args:
        path: a file, which may or may not exist.
        folder: whether `path` is a folder instead.
        option: the option of the command that chooses another place, for the message.

    Raises:
        DataError: it cannot be written; says why.
    """
    elsewhere = f"choose another place{f' with {option}' if option else ''}"
    try:
        if path.is_dir() and not folder:
            raise DataError(f"{path} is a folder: name a file in it to write to")
        place = path if folder else path.parent
        while not os.path.lexists(place):
            place = place.parent
        if not place.is_dir():
            raise DataError(f"cannot write {path}: {place} is not a folder; {elsewhere}")
        with tempfile.TemporaryFile(dir=place):  # permissions alone do not tell
            return path
    except OSError as error:
        why = error.strerror or str(error)
        raise DataError(f"{path} cannot be written ({why}): {elsewhere}") from error


def remove_partial(folder: Path, of: str = "") -> None:
    """Remove the partial files that killed writers left in `folder`, or only those of file `of`."""
    for path in folder.glob(f".{of}*{PARTIAL}"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def held(folder: Path, named: Path | None = None) -> Generator[None]:
    """Lock `folder` against other writers; the lock ends with the process, however it ends.

    On a file system without locks a second writer is not refused and may make the first one fail,
    but files under their final names are complete even then.

    Args:
        named: the folder to name in the message, if it is another one.

    Raises:
        DataError: another process holds the lock.
    """
    lock = folder / LOCK
    with _locked(lock, ENDING_SECONDS) as is_held:
        if not is_held:
            raise DataError(
                f"another command is writing to {named or folder}; wait for it or choose another "
                f"folder{_holder(lock)}"
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
    lock = path.with_name(f".{path.name}{LOCK}")
    if wait:
        with _locked(lock, NOTICE_SECONDS) as is_held:
            if is_held:
                remove_partial(path.parent, f"{path.name}.")
                yield True
                return
        message = f"waiting for another command, which is writing {path}{_holder(lock)}"
        warnings.warn(message, AcwmWarning, stacklevel=3)
    with _locked(lock, -1 if wait else 0) as is_held:
        if is_held:
            remove_partial(path.parent, f"{path.name}.")
        yield is_held


@contextlib.contextmanager
def _locked(path: Path, seconds: float) -> Generator[bool]:
    """Lock a file, waiting up to `seconds` (-1: for ever); yields whether it is locked."""
    from filelock import FileLock, Timeout

    lock = FileLock(path, timeout=seconds)
    try:
        lock.acquire()
    except Timeout:
        yield False
        return
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    try:
        _sign(path)
        yield True
    finally:
        lock.release()


def _sign(lock: Path) -> None:
    """Write into a lock that is held who holds it: process and host, as filelock itself does where
    a file system has no locks."""
    with contextlib.suppress(OSError):  # only messages need it
        owner = f"{os.getpid()}\n{socket.gethostname()}\n"
        if not lock.read_text("utf-8", "replace").startswith(owner):
            lock.write_text(owner, encoding="utf-8")


def _holder(lock: Path) -> str:
    """Who holds a lock, since when, and how to break it, in brackets; empty if nothing is known.

    A lock ends with its process, but the file system of a cluster may keep one whose node was lost.
    """
    try:
        pid, host = lock.read_text("utf-8", "replace").splitlines()[:2]
        seconds = max(0.0, time.time() - lock.stat().st_mtime)
    except (OSError, ValueError):
        return ""
    age = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
    age = age if seconds < 6000 else f"{seconds / 3600:.0f} h"
    is_here = host == socket.gethostname()
    holder = f"process {pid} on {'this machine' if is_here else host} has held it for {age}"
    way_out = "" if is_here and _runs(pid) else f"; if that has ended, delete {lock} and try again"
    return f" ({holder}{way_out})"


def inside(folder: Path, name: str) -> Path:
    """The file `name` of `folder`, for names that come from a file; it need not exist.

    Raises:
        DataError: the name, or a link on its way, leads out of the folder.
    """
    path = folder / name
    try:
        is_inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # links in a circle, or a null byte
        raise DataError(f"{path!s:.200} is no path ({error!s:.200})") from None
    if not is_inside:
        raise DataError(f"{path} leads out of {folder}, which is not allowed: put the file there")
    return path


def regular_file(folder: Path, name: str) -> Path:
    """The file `name` of `folder`, which somebody else filled.

    Raises:
        DataError: it is missing, leads out of the folder, or is no regular file: a folder, a
            device, or a pipe, which would be waited for without end.
    """
    path = inside(folder, name)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise DataError(f"{path} cannot be read ({why})") from error
    if not stat.S_ISREG(mode):
        raise DataError(f"{path} is not a regular file: put the file itself there")
    return path


def plain_name(name: str, what: str) -> str:
    """Return `name` if it may be part of a path: one that comes in a file decides no folder.

    Args:
        what: what bears the name, for the message, e.g. ``"an environment"``.

    Raises:
        ValueError: it has other characters than letters, digits, ``_ . + -`` and spaces, does not
            begin with a letter, digit or ``_``, or is longer than 200 characters.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{name[:80]!r} cannot be the name of {what}: use letters, digits, _, . and -"
        )
    return name


def check_inside(folder: Path, *own: str) -> None:
    """Refuse links that lead out of `folder` among the files that acwm reads or writes there.

    So are pipes and devices, which would be waited for without end.

    Args:
        folder: a dataset or a run.
        *own: patterns of the files, e.g. ``"*/*.tar"``. Other files are none of acwm's business.

    Raises:
        DataError: there is such a file; names it.
    """
    for pattern in own:
        for path in folder.glob(pattern):
            name = str(path.relative_to(folder))
            if inside(folder, name).exists() and not path.is_dir():
                regular_file(folder, name)


def check_tree(root: Path, *, follow_links: bool = False, advice: str = "") -> None:
    """Refuse pipes and devices in a folder of other people's files, and links that lead out of it.

    Hidden folders are left out. `root` itself may be a link.

    Args:
        root: the folder; or one file.
        follow_links: whether links may lead out of it. Files behind them are checked too.
        advice: what to do about a link, for the message.

    Raises:
        DataError: there is such a file; names it.
    """
    if root.is_dir():
        whole = os.path.realpath(root)
        for entry in _below(root):
            path = Path(entry.path)
            if not follow_links and entry.is_symlink() and not _lies_in(path, whole):
                out = advice or "put the file there"
                raise DataError(f"{path} is a link that leads out of {root}: {out}")
            with contextlib.suppress(OSError):  # a link to nothing is left to whoever reads it
                if not entry.is_file() and not entry.is_dir():
                    check_regular(path)
    elif root.exists():
        check_regular(root)


def _below(root: Path) -> Iterator[os.DirEntry[str]]:
    """What lies in a folder and in those below it, each folder once; a link comes before what is
    behind it. What cannot be listed is left to whoever reads it."""
    folders, seen = [str(root)], set[tuple[int, int]]()
    while folders:
        folder = folders.pop()
        with contextlib.suppress(OSError):
            place = Path(folder).stat()
            if (place.st_dev, place.st_ino) in seen:
                continue
            seen.add((place.st_dev, place.st_ino))
            with os.scandir(folder) as entries:
                for entry in entries:
                    yield entry
                    with contextlib.suppress(OSError):
                        if not entry.name.startswith(".") and entry.is_dir():
                            folders.append(entry.path)


def _lies_in(path: Path, folder: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(folder)


def check_regular(path: Path) -> None:
    """Refuse a pipe, a socket or a device, which may hang or give another's data.

    Raises:
        DataError: it is one.
        OSError: it does not exist or cannot be reached.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise DataError(f"{path} is not a file: it is a folder, a pipe, a socket or a device")


def check_fetched(path: Path) -> None:
    """Refuse a pointer of Git LFS, which is in the place of a file that was not fetched.

    Raises:
        DataError: it is one; says how to fetch the file.
    """
    try:
        check_regular(path)
        with path.open("rb") as file:
            start = file.read(len(LFS_POINTER))
    except OSError:
        return  # whoever reads it reports that
    if start == LFS_POINTER:
        raise DataError(f"{path} {_NOT_FETCHED}")


def parse_json(data: bytes | str) -> Any:
    """Parse JSON whose numbers are finite.

    Raises:
        ValueError: it is something else.
    """
    _refuse_pointer(data)
    try:
        content = json.loads(data)
        _finite_json(content)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    return content


def parse_yaml(text: str, loader: Any = None) -> Any:
    """Parse YAML of plain values.

    Args:
        loader: a loader of PyYAML that executes nothing; `yaml.SafeLoader` by default.

    Raises:
        ValueError: it is nested too deeply, refers to itself, or its aliases stand for more than
            `MOST_VALUES` values, which a few lines can do.
        yaml.YAMLError: it is no YAML.
    """
    import yaml

    loader = loader or yaml.SafeLoader
    _refuse_pointer(text)
    if len(text) > KEPT_TEXT:
        return _parsed(text, loader)
    return copy.deepcopy(_kept(text, loader))


def _refuse_pointer(content: bytes | str) -> None:
    """Refuse what Git LFS puts in the place of a text; `ValueError`."""
    start = content if isinstance(content, bytes) else content[:100].encode("utf-8", "replace")
    if start.startswith(LFS_POINTER):
        raise ValueError(f"it {_NOT_FETCHED}")


@functools.lru_cache(maxsize=256)
def _kept(text: str, loader: Any) -> Any:
    """What a text says: recipes, overlays and cards are read again and again, and slowly."""
    return _parsed(text, loader)


def _parsed(text: str, loader: Any) -> Any:
    reader: Any = loader(text)
    try:
        node = reader.get_single_node()
        if node is None:
            return None
        if _values(node, {}) > MOST_VALUES:
            raise ValueError(f"its aliases stand for more than {MOST_VALUES:,} values")
        return reader.construct_document(node)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    finally:
        reader.dispose()


def _values(node: Any, known: dict[int, int]) -> int:
    """The number of values below a node of YAML, each counted as often as aliases repeat it."""
    if isinstance(node.value, str):
        return 1
    if (count := known.get(id(node))) is not None:
        if not count:
            raise ValueError("it refers to itself")
        return count
    known[id(node)] = 0
    items: list[Any] = node.value
    pairs: list[tuple[Any, ...]] = [item if isinstance(item, tuple) else (item,) for item in items]
    known[id(node)] = 1 + sum(_values(part, known) for pair in pairs for part in pair)
    return known[id(node)]


def _finite_json(values: object) -> str:
    """Turn values into JSON; `ValueError` if a number is not finite."""
    try:
        return json.dumps(values, allow_nan=False)
    except ValueError as error:
        raise ValueError("it has numbers that are not finite") from error


def read_json(path: Path, kind: type[T], what: str) -> T:
    """Read a JSON file as a dataclass; entries that the dataclass does not have are left out.

    Args:
        path: the file.
        kind: a dataclass.
        what: what the file should be, for the message, e.g. ``"a summary"``.

    Raises:
        DataError: it is damaged, or of another version of acwm.
        OSError: it does not exist or cannot be read.
    """
    check_fetched(path)
    try:
        return typed(parse_json(path.read_bytes()), kind)
    except ValueError as error:
        why = f"{path} is not {what} of this version of acwm ({error})"
        raise DataError(why) from None


def typed(values: Any, kind: type[T]) -> T:
    """Convert values of JSON types to `kind`, checked strictly: a string never becomes a number.

    Raises:
        ValueError: a value has the wrong type or is not finite; the one-line message says which.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_json(_finite_json(values), strict=True)
    except ValidationError as error:
        reason = error.errors()[0]
        where = ".".join(map(str, reason["loc"]))[:200]
        said = reason["msg"].splitlines()[0].removeprefix("Value error, ")[:200]
        raise ValueError(f"{where}: {said}" if where else said) from None


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter[Any](kind)


def training_record(path: Path) -> dict[str, Any]:
    """How the weights in a safetensors file were made (data, seed, steps), as the file says.

    Raises:
        DataError: the file is damaged, or does not say it.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with cast(Any, safe_open)(path, framework="numpy") as file:
            metadata: dict[str, str] = file.metadata() or {}
        return dict(parse_json(metadata.get("training", "{}")))
    except (OSError, SafetensorError, ValueError, TypeError) as error:
        check_fetched(path)
        raise DataError(f"{path} does not say how its weights were made ({error})") from error


def load_plain(path: Path, *, on_disk: bool = False) -> object:
    """The numbers, text, tensors, arrays, lists and dicts in a file of `torch.save`.

    Args:
        on_disk: leave the tensors in the file until they are used, if its format allows this.

    Raises:
        DataError: it is missing, damaged, or holds anything else; nothing in it was run.
    """
    import numpy as np
    import torch

    scalar, array = np.float64(0).__reduce__()[0], np.zeros(0).__reduce__()[0]
    dtypes = {type(np.dtype(code)) for code in "?bhilqBHILQefdSU"}
    old = (scalar, "numpy.core.multiarray.scalar"), (array, "numpy.core.multiarray._reconstruct")
    plain: list[Any] = [np.ndarray, np.dtype, *dtypes, scalar, array, *old]
    if not path.is_file():
        raise DataError(f"{path} is missing")
    mapped = on_disk and zipfile.is_zipfile(path)  # before PyTorch 1.6 it was no zip
    try:
        with torch.serialization.safe_globals(plain), warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except Exception as error:  # a damaged file can make the parsers raise anything
        check_fetched(path)
        raise DataError(
            f"{path} is damaged, or holds more than numbers and text, and nothing in it was run "
            f"({type(error).__name__})"
        ) from error
