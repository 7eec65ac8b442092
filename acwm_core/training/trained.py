"""Runs by name: a folder, or a trained model that a plugin ships or fetches. Free of torch."""

from __future__ import annotations

import filecmp
import shutil
from pathlib import Path

from acwm_core.catalog import catalog
from acwm_core.data.atomic import alone, made_whole, writing
from acwm_core.errors import TrainingError

COPIES = Path("runs", "trained")
"""Where what comes of a trained model is written: its own folder may be part of a package."""


def trained_models() -> list[str]:
    """The names of those that are installed."""
    return [each.name for each in catalog().registry("trained_model") if not each.requires]


def find_run(name: str | Path) -> Path:
    """The folder of a trained model by its name or address (``hf://ORG/NAME``).

    Everything else is a folder itself, and so is a name by which a run folder lies here.
    """
    source, _, address = str(name).partition("://")
    registry = catalog().registry("trained_model")
    if source not in registry or (Path(name) / "recipe.yaml").is_file():
        return Path(name)
    return registry[source].create_as(Path, **({"address": address} if address else {}))


def run_to_write(name: str | Path) -> Path:
    """The same, as a folder that results can be written to: of a trained model a copy in `COPIES`.

    Raises:
        TrainingError: the copy that is there is of another version.
    """
    source = find_run(name)
    if source == Path(name):
        return source
    copy, weights = COPIES / str(name).rpartition("://")[2].replace("/", "--"), "model.safetensors"
    if not copy.exists():
        with writing(copy):
            COPIES.mkdir(parents=True, exist_ok=True)
            with alone(copy):  # another command may be making it
                if not copy.exists():
                    with made_whole(copy) as partial:
                        shutil.copytree(source, partial, dirs_exist_ok=True)
    if not filecmp.cmp(source / weights, copy / weights, shallow=False):
        raise TrainingError(f"{copy} holds another version of {name}: move it away to use this one")
    return copy
