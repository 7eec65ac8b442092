"""Where recordings lie: a path, or a URL whose files are fetched first."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from acwm_core.data import remote
from acwm_core.errors import DataError
from acwm_core.files import OF_THE_DISK, inside

AT_ONCE = 8  # files


def is_url(source: str) -> bool:
    """Whether it is a URL such as ``hf://datasets/ORG/NAME``, ``s3://…`` or ``https://…``."""
    return "://" in source and not Path(source).exists()


def fetched(url: str, *, progress: bool = True) -> Path:
    """Fetch the file or folder behind a URL into the cache, and return where it lies there.

    Files that are there already stay; a folder that has changed is fetched as another.

    Raises:
        DataError: there is nothing behind the URL, or it cannot be fetched.
        MissingExtraError: the package for this kind of URL is not installed.
    """
    url = url.rstrip("/")
    sizes = _listed(url)
    told = json.dumps([url, sorted(sizes.items())])
    digest = hashlib.sha256(told.encode()).hexdigest()[:16]
    name = PurePosixPath(url).name
    place = remote.cache_folder() / "imports" / digest / name
    wanted = {rest: inside(place, rest) if rest else place for rest in sizes}
    missing = {rest: path for rest, path in wanted.items() if not path.exists()}
    try:
        for path in missing.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        _fetch_all(url, missing, progress)
    except OSError as error:
        where = f"cannot write to {place.parent} ({error.strerror})"
        raise DataError(f"{where}: make room, or set {remote.CACHE} to another folder") from error
    return place


def _listed(url: str) -> dict[str, Any]:
    """What tells each file's content apart, by its path below the URL; "" for the URL itself."""
    system, root = remote.located(url)
    try:
        found = system.find(root, detail=True)
        if not found and system.isfile(root):
            found = {root: system.info(root)}
    except FileNotFoundError:
        found = {}
    except Exception as error:  # every protocol has its own exceptions
        if isinstance(error, OSError) and error.errno in OF_THE_DISK:
            raise
        raise DataError(f"cannot list {url}: {type(error).__name__}: {error}") from error
    if not found:
        raise DataError(f"there is nothing behind {url}")
    base = root.rstrip("/")
    return {
        name.removeprefix(base).lstrip("/"): [
            str(facts.get(key, "")) for key in ("size", "ETag", "etag", "blob_id", "mtime")
        ]
        for name, facts in found.items()
    }


def _fetch_all(url: str, missing: dict[str, Path], progress: bool) -> None:
    from rich.console import Console
    from rich.progress import track

    with ThreadPoolExecutor(AT_ONCE) as pool:
        calls = [
            pool.submit(remote.fetch, f"{url}/{rest}" if rest else url, path)
            for rest, path in missing.items()
        ]
        try:
            shown = Console(stderr=True)
            for call in track(calls, f"fetching {url}", console=shown, disable=not progress):
                call.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
