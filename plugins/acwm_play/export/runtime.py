"""ONNX Runtime for browsers: the npm package onnxruntime-web, fetched once and cached."""

from __future__ import annotations

import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

from acwm_core.errors import DataError, RecipeError
from acwm_core.files import cache_folder, made_whole, writing

PACKAGE, VERSION = "onnxruntime-web", "1.30.0"

FILES = {
    "ort": "ort.wasm.min.js",
    "glue": "ort-wasm-simd-threaded.mjs",
    "wasm": "ort-wasm-simd-threaded.wasm",
}
"""Files that the page needs from the package's folder `dist`."""


def runtime(folder: Path | None = None) -> dict[str, bytes]:
    """The contents of the files, by their names in `FILES`.

    Args:
        folder: folder of the package; by default it is fetched by npm and kept in the cache.

    Raises:
        RecipeError: the folder is not that of the package, or npm is not installed.
        DataError: npm could not fetch it.
    """
    dist = folder / "dist" if folder else cache_folder() / f"{PACKAGE}-{VERSION}"
    if folder is None and not dist.is_dir():
        _fetch(dist)
    missing = [name for name in FILES.values() if not (dist / name).is_file()]
    if missing:
        raise RecipeError(
            f"{dist.parent} is not a folder of {PACKAGE}: it has no dist/{missing[0]}"
        )
    return {key: (dist / name).read_bytes() for key, name in FILES.items()}


def _fetch(dist: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        raise RecipeError(
            f"npm is needed once, to fetch {PACKAGE}: install Node.js, or name a folder of that "
            "package with --runtime"
        )
    with tempfile.TemporaryDirectory() as scratch:
        words = [npm, "pack", f"{PACKAGE}@{VERSION}", "--silent", "--pack-destination", scratch]
        process = subprocess.run(words, capture_output=True, text=True, check=False, cwd=scratch)
        packages = list(Path(scratch).glob("*.tgz"))
        if process.returncode or not packages:
            reason = (process.stderr.strip() or "it is not there").splitlines()[-1]
            raise DataError(f"npm could not fetch {PACKAGE} {VERSION}: {reason}")
        with writing(dist), made_whole(dist) as partial, tarfile.open(packages[0]) as archive:
            for name in FILES.values():
                file = archive.extractfile(f"package/dist/{name}")
                assert file is not None
                (partial / name).write_bytes(file.read())
