"""Runs on the Hugging Face Hub: fetched and published as files that are never executed."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path

from huggingface_hub import HfApi

from acwm_core.errors import AcwmError, TrainingError
from acwm_core.files import disk_error, inside, written_whole
from acwm_zoo.packing import FILES

SCHEME = "hf://"


def fetch(address: str = "") -> Path:
    """Download a run; returns its folder, which holds only the run's files.

    Args:
        address: ``ORG/NAME``, or ``ORG/NAME@REVISION``.

    Raises:
        TrainingError: the repository does not exist, holds no run, or cannot be reached.
    """
    repository, _, revision = address.partition("@")
    if repository.count("/") != 1:
        raise TrainingError(f"hf://{address} names no run: write hf://ORG/NAME")
    with _explained(f"{SCHEME}{address}"):
        snapshot = HfApi().snapshot_download(
            repository, revision=revision or None, allow_patterns=list(FILES)
        )
    folder = _without_links(Path(snapshot))
    for name in ("recipe.yaml", "model.safetensors"):
        if not (folder / name).is_file():
            raise TrainingError(f"{SCHEME}{address} holds no trained run: it has no {name}")
    return folder


def _without_links(folder: Path) -> Path:
    """Replace the links of the Hub's cache by copies: a run's files lie in its own folder.

    Returns:
        The folder; if the cache is read-only, one that lasts as long as this process.

    Raises:
        DataError: a link leads out of the cache.
    """
    cache, own = folder.parents[1], folder
    linked = [file for each in FILES for file in folder.glob(each) if file.is_symlink()]
    if linked and not os.access(folder, os.W_OK):
        temporary = tempfile.TemporaryDirectory(prefix="acwm-")
        atexit.register(temporary.cleanup)
        own = Path(temporary.name)
    for file in linked:
        if inside(cache, str(file.relative_to(cache))).is_file():
            copy = own / file.relative_to(folder)
            copy.parent.mkdir(exist_ok=True)
            with written_whole(copy) as partial:
                shutil.copyfile(file.resolve(), partial)
    return own


def create(address: str) -> str:
    """Create the repository ``ORG/NAME`` if it does not exist; returns the address of its page.

    Raises:
        TrainingError: that is not allowed, or the Hub cannot be reached.
    """
    with _explained(f"{SCHEME}{address}"):
        return str(HfApi().create_repo(address, exist_ok=True))


def publish(folder: Path, address: str) -> None:
    """Publish the files of a trained model in an existing repository.

    Args:
        folder: folder of the trained model; see `acwm_zoo.packing.pack`.
        address: ``ORG/NAME``.

    Raises:
        TrainingError: publishing is not allowed, or the Hub cannot be reached.
    """
    with _explained(f"{SCHEME}{address}"):
        HfApi().upload_folder(
            folder_path=folder,
            repo_id=address,
            allow_patterns=list(FILES),
            commit_message="acwm push",
        )


@contextlib.contextmanager
def _explained(what: str) -> Generator[None]:
    try:
        yield
    except AcwmError:
        raise
    except Exception as error:  # the library's errors, and any error from an unexpected answer
        if full := disk_error(error):
            where = f"the Hub's cache cannot be written ({full.strerror})"
            raise TrainingError(f"{what}: {where}; set HF_HOME to another folder") from error
        reason = " ".join(str(error).split())[:200]
        raise TrainingError(f"{what} is not available ({reason}): see `hf auth login`") from error
