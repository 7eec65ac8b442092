"""Runs on the Hugging Face Hub: fetched and published as files that are never executed."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from pathlib import Path

from huggingface_hub import HfApi

from acwm_core.errors import AcwmError, TrainingError
from acwm_core.files import inside, written_whole
from acwm_zoo.packing import FILES

SCHEME = "hf://"


def fetch(address: str = "") -> Path:
    """Download a run; returns its folder in the Hub's cache, which holds only the run's files.

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
    folder = Path(snapshot)
    _without_links(folder)
    for name in ("recipe.yaml", "model.safetensors"):
        if not (folder / name).is_file():
            raise TrainingError(f"{SCHEME}{address} holds no trained run: it has no {name}")
    return folder


def _without_links(folder: Path) -> None:
    """Replace the links of the Hub's cache by copies: a run's files lie in its own folder.

    Raises:
        DataError: a link leads out of the cache.
    """
    cache = folder.parents[1]
    for file in [each for pattern in FILES for each in folder.glob(pattern)]:
        if file.is_symlink() and inside(cache, str(file.relative_to(cache))).is_file():
            with written_whole(file) as partial:
                shutil.copyfile(file.resolve(), partial)


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
        reason = " ".join(str(error).split())[:200]
        raise TrainingError(f"{what} is not available ({reason}): see `hf auth login`") from error
