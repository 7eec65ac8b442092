"""Datasets behind a URL: whole shards, fetched when they are first used and kept in a cache.

A card and its manifests name every file and its checksum, so no remote folder needs to be listed.
The cache holds each version of a dataset as an ordinary data folder that fills up over time, with
the URL in the file `ORIGIN`. Latents of the dataset are stored there, too.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
import tempfile
import time
from pathlib import Path
from typing import Any, cast

from acwm_core.data.card import CARD, MANIFEST, DatasetCard
from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError, MissingExtraError
from acwm_core.files import CACHE, OF_THE_DISK, alone, cache_folder, written_whole

ORIGIN = ".origin"
WAITS = (0.5, 2.0, 8.0)
"""Seconds before the second and each further attempt to fetch a file."""

PROTOCOLS = {
    "https": "aiohttp",
    "http": "aiohttp",
    "hf": "huggingface_hub",
    "s3": "s3fs",
    "gs": "gcsfs",
    "file": "fsspec",
    "memory": "fsspec",
}
"""Supported URL protocols, and the package that reads each."""

URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")


def data_folder(path: str | Path) -> Path:
    """The local folder of a dataset: `path` itself, or a folder in the cache if it is a URL.

    For a URL, the card and the manifests are always fetched, so that a changed dataset is not
    mistaken for the cached one. Its shards are fetched later, by `fetch_shard`.

    Raises:
        DataError: the URL is not supported, or there is no dataset behind it.
        MissingExtraError: the package for this kind of URL is not installed.
    """
    if isinstance(path, Path) or not URL.match(path) or Path(path).exists():
        return Path(path)
    url = path.rstrip("/")
    cache = cache_folder() / "data"
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as temporary:
            return _kept(url, Path(temporary), cache)
    except OSError as error:
        raise DataError(f"cannot write to {cache} ({error.strerror}); set {CACHE}") from error


def _kept(url: str, fresh: Path, cache: Path) -> Path:
    """Fetch card and manifests into `fresh`; return the folder in `cache` with the same ones."""
    fetch(f"{url}/{CARD}", fresh / CARD)
    names = [CARD]
    for split in DatasetCard.read(fresh).splits:
        (fresh / split).mkdir()
        names.append(f"{split}/{MANIFEST}")
        fetch(f"{url}/{names[-1]}", fresh / names[-1])
    contents = {name: (fresh / name).read_bytes() for name in names}
    digest = hashlib.sha256(url.encode())
    for data in contents.values():
        digest.update(hashlib.sha256(data).digest())
    name = re.sub(r"[^\w-]", "_", url.rpartition("/")[2])[:40]
    folder = cache / f"{name}-{digest.hexdigest()[:16]}"
    for name, data in {**contents, ORIGIN: url.encode()}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if not (folder / name).exists():
            with written_whole(folder / name) as partial:
                partial.write_bytes(data)
    return folder


def origin(folder: Path) -> str | None:
    """The URL that a folder of the cache was fetched from; None for any other folder."""
    file = folder / ORIGIN
    return file.read_bytes().decode() if file.exists() else None


def fetch_shard(url: str, path: Path, sha256: str) -> None:
    """Fetch a shard with the checksum `sha256` from `url` to `path`, unless it is there.

    If several processes want it, one fetches it and the others wait.

    Raises:
        DataError: it cannot be fetched or written, or is not what the manifest says.
    """
    try:
        with alone(path):
            if not path.exists():
                fetch(url, path, sha256)
    except OSError as error:
        raise DataError(
            f"cannot write {path} ({error.strerror}): make room, or set {CACHE} to another folder"
        ) from error


def fetch(url: str, path: Path, sha256: str | None = None) -> None:
    """Fetch one file, atomically; failures that may pass are retried."""
    system, name = located(url)
    for wait in (*WAITS, None):
        try:
            with written_whole(path) as partial:
                system.get_file(name, str(partial))
                if sha256 and file_sha256(partial) != sha256:
                    raise ValueError("it has another checksum than the dataset's manifest says")
            return
        except FileNotFoundError:
            raise DataError(f"there is no {url}") from None
        except Exception as error:  # every protocol has its own exceptions
            if isinstance(error, OSError) and error.errno in OF_THE_DISK:
                raise
            if wait is None:
                problem = f"{type(error).__name__}: {error}"
                raise DataError(f"cannot fetch {url}: {problem}") from error
            time.sleep(wait)


def located(url: str) -> tuple[Any, str]:
    """The fsspec file system of `url`, and the name of the file in it."""
    match = URL.match(url)
    protocol = match.group(1).lower() if match else ""
    if protocol not in PROTOCOLS or "://" not in url or "::" in url:
        known = ", ".join(f"{name}://" for name in PROTOCOLS)
        raise DataError(f"{url} is not a supported address; URLs begin with {known}")
    package = PROTOCOLS[protocol]
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(f"{protocol}:// needs the package {package}: pip install {package}")
    import fsspec  # pyright: ignore[reportMissingTypeStubs]

    options: dict[str, Any] = {}
    if protocol in ("http", "https"):
        from aiohttp import ClientTimeout

        # No limit for the whole transfer, but give up a connection that is silent for a minute.
        silent = ClientTimeout(total=None, sock_connect=30, sock_read=60)
        options = {"client_kwargs": {"timeout": silent}}
    return cast(Any, fsspec).url_to_fs(url, **options)
