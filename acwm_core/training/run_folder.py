"""Run folders, and how they are found by name. Does not import torch."""

from __future__ import annotations

import filecmp
import inspect
import shlex
import shutil
from pathlib import Path

from acwm_core.errors import RecipeError, TrainingError
from acwm_core.files import alone, check_inside, made_whole, writing
from acwm_core.plugins import catalog
from acwm_core.recipe.compose import read_recipe
from acwm_core.recipe.trust import refuse_code

COPIES = Path("runs", "trained")
"""Folder for results of trained models, whose own folder may be part of a package."""

OWN = (
    *("recipe.yaml", "card.yaml", "*.safetensors", "metrics.csv", "README.md", "loggers.json"),
    *(
        f"{folder}{rest}"
        for folder in ("checkpoints", "samples", "evaluation", "planning")
        for rest in ("", "/**/*")
    ),
)
"""Patterns of acwm's own files in a run folder; loggers such as wandb write others."""


class RunFolder:
    """The paths of one run.

    Attributes:
        path: the folder, e.g. ``runs/push_cube``.
        recipe: the fully expanded recipe; a folder that contains it holds a run.
        card: a copy of the dataset's card.
        checkpoints: folder of Lightning's checkpoints, `last.ckpt` and `best.ckpt`.
        last_checkpoint: the checkpoint from which a run resumes.
        weights: the averaged weights of model and conditioner, for prediction.
        metrics: logged metrics by step, as CSV.
        samples: sample videos made during training.
        loggers: the ids of this run at services such as Weights & Biases.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = path = Path(path)
        self.recipe = path / "recipe.yaml"
        self.card = path / "card.yaml"
        self.checkpoints = path / "checkpoints"
        self.last_checkpoint = self.checkpoints / "last.ckpt"
        self.weights = path / "model.safetensors"
        self.metrics = path / "metrics.csv"
        self.samples = path / "samples"
        self.loggers = path / "loggers.json"

    def check_links(self) -> None:
        """Refuse links that lead out of the folder among acwm's own files."""
        check_inside(self.path, *OWN)

    def check_resumable(self) -> None:
        """Refuse a folder with weights and without checkpoints, as of a trained model."""
        if self.weights.exists() and not any(self.checkpoints.glob("*last.ckpt*")):
            raise TrainingError(
                f"{self.path} holds weights but no checkpoint to resume from: start from them with "
                f"training.init_from={self.path}, and train into another folder"
            )


def resume_command(run: RunFolder) -> str:
    """The command that continues a run; all else is in its recipe."""
    try:
        refuse_code(read_recipe(run.recipe))
        trust = ""
    except RecipeError:  # code that was typed when the run was started
        trust = " --trust-recipe"
    return f"acwm fit resume={shlex.quote(str(run.path))}{trust}"


def trained_models() -> list[str]:
    """The names of the installed trained models."""
    return [model.name for model in catalog().registry("trained_model") if not model.requires]


def find_run(name: str | Path) -> Path:
    """The folder of a trained model, by its name or address (``hf://ORG/NAME``).

    Any other name is taken as the path of a folder; so is a name under which there is a run folder
    here.

    Raises:
        TrainingError: there is an address, but only a name is possible.
    """
    source, _, address = str(name).partition("://")
    registry = catalog().registry("trained_model")
    if source not in registry or (Path(name) / "recipe.yaml").is_file():
        return Path(name)
    component = registry[source]
    if not address:
        return component.create_as(Path)
    if "address" not in inspect.signature(component.load()).parameters:
        raise TrainingError(f"{name} is not an address: the trained model is called {source}")
    return component.create_as(Path, address=address)


def copy_of(name: str | Path) -> Path:
    """The folder of a trained model's copy, which may not exist yet."""
    return COPIES / str(name).rpartition("://")[2].replace("/", "--")


def run_to_write(name: str | Path) -> Path:
    """Like `find_run`, but a writable folder: for a trained model, a copy in `COPIES`.

    Raises:
        TrainingError: the existing folder is no copy of it, or of another version.
    """
    source = find_run(name)
    if source == Path(name):
        return source
    copy, weights = copy_of(name), "model.safetensors"
    if not copy.exists():
        with writing(copy):
            COPIES.mkdir(parents=True, exist_ok=True)
            with alone(copy):  # another command may be creating it
                if not copy.exists():
                    with made_whole(copy) as partial:
                        shutil.copytree(source, partial, dirs_exist_ok=True)
    ours, theirs = copy / weights, source / weights
    if not ours.is_file() or not filecmp.cmp(theirs, ours, shallow=False):
        raise TrainingError(f"{copy} holds something other than this {name}: move it away")
    return copy
