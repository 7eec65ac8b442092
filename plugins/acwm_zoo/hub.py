"""Runs on the Hugging Face Hub: fetched and published as files, nothing of which is executed."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Generator
from pathlib import Path

from huggingface_hub import HfApi

from acwm_core.data.atomic import written_whole
from acwm_core.errors import AcwmError, TrainingError
from acwm_zoo.packing import FILES

SCHEME = "hf://"


def fetch(address: str = "") -> Path:
    """The folder in the cache of the hub with the files of a run, and no others.

    Args:
        address: ``ORG/NAME``, or ``ORG/NAME@REVISION``.

    Raises:
        TrainingError: there is no such repository, it holds no run, or it cannot be reached.
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
    if not (folder / "recipe.yaml").is_file():
        raise TrainingError(f"{SCHEME}{address} holds no run: it has no recipe.yaml")
    return folder


def _without_links(folder: Path) -> None:
    """The cache of the hub links to its files elsewhere, and a run's folder may hold no links.

    Raises:
        TrainingError: a link leads to something else.
    """
    blobs = folder.resolve().parents[1] / "blobs"
    for file in [*folder.rglob("*")]:
        if file.is_symlink():
            content = file.resolve()
            if content.parent != blobs or not content.is_file():
                raise TrainingError(f"{file} is a link that leads out of the cache: remove it")
            with written_whole(file) as partial:
                shutil.copyfile(content, partial)


def publish(folder: Path, address: str) -> str:
    """Publish the files of a trained model; the repository is made if it is not there.

    Args:
        folder: the trained model, see `acwm_zoo.packing.pack`.
        address: ``ORG/NAME``.

    Returns:
        The address of its page.

    Raises:
        TrainingError: it is not allowed, or the hub cannot be reached.
    """
    with _explained(f"{SCHEME}{address}"):
        api = HfApi()
        made = api.create_repo(address, exist_ok=True)
        api.upload_folder(
            folder_path=folder,
            repo_id=address,
            allow_patterns=list(FILES),
            commit_message="acwm push",
        )
    return str(made)


@contextlib.contextmanager
def _explained(what: str) -> Generator[None]:
    try:
        yield
    except AcwmError:
        raise
    except Exception as error:  # the library's own; and whatever it makes of a strange answer
        reason = " ".join(str(error).split())[:200]
        raise TrainingError(f"{what} is not available ({reason}): see `hf auth login`") from error
