"""Where recordings lie: a path, or a URL whose files are fetched.

Videos are most of the bytes, and an import needs those of its cameras alone. So all files but
videos are fetched at first; a video's place is held by an empty file of its size and of the date 0
until it is read. A file is replaced as a whole, so that nothing half fetched is taken for it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import json
import os
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from acwm_core.data import remote
from acwm_core.errors import AcwmError, DataError
from acwm_core.files import OF_THE_DISK, alone, check_tree, inside, written_whole
from acwm_formats.names import natural

AT_ONCE = 8  # files
VIDEOS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".gif")
LISTING = "listing.json"

Marks = dict[str, list[str]]
"""What tells each file's content apart, by its path below the URL; "" for the URL itself."""


def guarded(read: Callable[..., Any]) -> Any:
    """Make a `Format.read` check what lies in its first argument before it reads it.

    Links that lead out of it are refused unless the option `follow_links` allows them; all errors
    of damaged files become a `DataError`.
    """

    @functools.wraps(read)
    def guarded_read(self: Any, root: Path, **options: Any) -> Any:
        inspect.signature(read).bind(self, root, **options)  # a misspelt option is no damage
        follow = options.get("follow_links", False)
        check_tree(Path(root), follow_links=follow, advice="give --follow-links to read it")
        with damage_of(root):
            return read(self, root, **options)

    return guarded_read


@contextlib.contextmanager
def damage_of(path: str | Path) -> Generator[None]:
    """Turn all errors that a damaged or forged file causes in the block into a `DataError`."""
    try:
        yield
    except (AcwmError, NameError):  # which no file causes
        raise
    except Exception as error:  # every library has its own exceptions
        why = " ".join(str(error).split())[:200]
        what = f"{type(error).__name__}: {why}".removesuffix(": ")
        raise DataError(f"{path} cannot be read: it is damaged, or forged ({what})") from error


def files_in(folder: Path, endings: Iterable[str]) -> list[Path]:
    """The files or folders with one of some endings, in natural order.

    Hidden ones are left out: macOS puts a ``._take.mp4`` beside ``take.mp4`` on other disks.
    """
    known = tuple(endings)
    paths = [
        path
        for path in folder.iterdir()
        if path.name.lower().endswith(known) and not path.name.startswith(".")
    ]
    return sorted(paths, key=lambda path: natural(path.name))


def is_url(source: str) -> bool:
    """Whether it is a URL such as ``hf://datasets/ORG/NAME``, ``s3://…`` or ``https://…``."""
    return "://" in source and not Path(source).exists()


def fetched(url: str, *, progress: bool = True) -> Path:
    """Fetch the file or folder behind a URL into the cache, and return where it lies there.

    Videos in a folder are fetched later, by `present`. Files that are there already stay; a folder
    that has changed is fetched as another.

    Raises:
        DataError: there is nothing behind the URL, or it cannot be fetched.
        MissingExtraError: the package for this kind of URL is not installed.
    """
    url = url.rstrip("/")
    if url.startswith("file://"):  # its links are checked in place
        return Path(unquote(urlsplit(url).path))
    marks = _listed(url)
    digest = hashlib.sha256(json.dumps([url, sorted(marks.items())]).encode()).hexdigest()[:16]
    place = _imports() / digest / PurePosixPath(url).name
    wanted = {rest: inside(place, rest) if rest else place for rest in marks}
    missing = {rest: path for rest, path in wanted.items() if not path.exists()}
    late = {rest for rest in missing if _is_late(rest, marks[rest])}
    try:
        for path in missing.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        if not (listing := place.parent / LISTING).exists():
            with written_whole(listing) as partial:
                partial.write_text(json.dumps({"url": url, "marks": marks}), encoding="utf-8")
        for rest in late:
            _promise(missing[rest], int(marks[rest][0]))
        _fetch_all(url, {r: path for r, path in missing.items() if r not in late}, progress)
    except OSError as error:
        raise _unwritable(place.parent, error) from error
    return place


def present(path: Path) -> None:
    """Fetch a video that is only promised; any other file stays as it is.

    Raises:
        DataError: it cannot be fetched, or has changed since it was listed.
    """
    if not _is_promised(path):
        return
    parts = path.resolve().relative_to(_imports()).parts
    url, marks = _listing(_imports() / parts[0] / LISTING)
    rest = "/".join(parts[2:])
    try:
        with alone(path):
            if not _is_promised(path):
                return  # another process has fetched it
            if _now(f"{url}/{rest}") != marks[rest]:
                raise DataError(f"{url}/{rest} has changed: run the same command again")
            remote.fetch(f"{url}/{rest}", path)
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _now(url: str) -> list[str]:
    system, name = remote.located(url)
    try:
        return _marks(system.info(name))
    except Exception as error:  # every protocol has its own exceptions
        raise DataError(f"cannot fetch {url}: {type(error).__name__}: {error}") from error


def _is_promised(path: Path) -> bool:
    try:
        empty = path.stat().st_mtime_ns == 0
    except OSError:
        return False  # whoever reads it will tell
    return empty and path.resolve().is_relative_to(_imports())


def _imports() -> Path:
    return (remote.cache_folder() / "imports").resolve()


def _is_late(rest: str, marks: list[str]) -> bool:
    return rest.lower().endswith(VIDEOS) and marks[0].isdecimal()


def _promise(path: Path, size: int) -> None:
    partial = path.with_name(f".{path.name}.promised")
    partial.touch()
    os.truncate(partial, size)
    os.utime(partial, (0, 0))
    partial.replace(path)


@functools.lru_cache(maxsize=2)
def _listing(path: Path) -> tuple[str, Mapping[str, list[str]]]:
    content = json.loads(path.read_bytes())
    return content["url"], content["marks"]


def _unwritable(folder: Path, error: OSError) -> DataError:
    where = f"cannot write to {folder} ({error.strerror})"
    return DataError(f"{where}: make room, or set {remote.CACHE} to another folder")


def _listed(url: str) -> Marks:
    system, root = remote.located(url)
    try:
        files = _found(system, root, url.startswith("http"))
    except FileNotFoundError:
        files = {}
    except Exception as error:  # every protocol has its own exceptions
        if isinstance(error, OSError) and error.errno in OF_THE_DISK:
            raise
        raise DataError(f"cannot list {url}: {type(error).__name__}: {error}") from error
    if not files:
        raise DataError(f"there is nothing behind {url}")
    base = root.rstrip("/")
    return {name.removeprefix(base).lstrip("/"): _marks(facts) for name, facts in files.items()}


def _found(system: Any, root: str, is_web: bool) -> dict[str, Any]:
    """The status of each file, by the file system."""
    if is_web and system.info(root).get("mimetype") != "text/html":
        return {root: system.info(root)}
    files = system.find(root, detail=True)
    if not files and system.isfile(root):
        files = {root: system.info(root)}
    if is_web:  # its pages name files, and nothing that tells a changed one
        with ThreadPoolExecutor(AT_ONCE) as pool:
            files = dict(zip(files, pool.map(system.info, files), strict=True))
    return files


def _marks(facts: Mapping[str, Any]) -> list[str]:
    names = ("size", "ETag", "etag", "blob_id", "mtime", "Last-Modified")
    return [str(facts.get(name, "")) for name in names]


def _fetch_all(url: str, missing: dict[str, Path], progress: bool) -> None:
    from rich.console import Console
    from rich.progress import track

    with ThreadPoolExecutor(AT_ONCE) as pool:
        calls: list[Any] = [
            pool.submit(remote.fetch, f"{url}/{rest}" if rest else url, path)
            for rest, path in missing.items()
        ]
        try:
            console = Console(stderr=True)
            for call in track(calls, f"fetching {url}", console=console, disable=not progress):
                call.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
