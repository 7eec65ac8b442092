"""Whether a run folder can be filled or gone on with, and from where."""

from __future__ import annotations

from acwm_core.data.card import DatasetCard
from acwm_core.errors import TrainingError
from acwm_core.recipe import Recipe
from acwm_core.recipe.differences import recipe_differences
from acwm_core.training.checkpoints import last_whole, read_details
from acwm_core.training.run import RunFolder, read_metadata

AUTO = "auto"
"""In place of a run to resume: go on if there is something to go on with, else start."""


def check_folder(
    run: RunFolder, recipe: Recipe, card: DatasetCard, *, goes_on: bool, may_restart: bool
) -> None:
    """Refuse a folder that is taken, or a run that cannot go on with this recipe and data.

    Args:
        run: the folder.
        recipe: what is to be trained now.
        card: of the data to train on now.
        goes_on: whether to resume the run.
        may_restart: whether a run that stopped before its first checkpoint may start again.

    Raises:
        TrainingError: with what to do about it.
    """
    if run.weights.exists() and "imported" in read_metadata(run.weights):
        raise TrainingError(
            f"{run.path} holds imported weights and no training to go on with: start from them by "
            f"training.init_from={run.path}, and train into another folder"
        )
    saved = last_whole(run.last_checkpoint) is not None
    if not goes_on:
        if run.recipe.exists() and saved:
            raise TrainingError(
                f"{run.path} holds a run already: go on with it by resume={run.path}, or choose "
                "another folder"
            )
        if run.recipe.exists() and not may_restart:
            raise TrainingError(
                f"{run.path} holds a run without a checkpoint: remove the folder if it was "
                "stopped, or choose another"
            )
    elif not run.recipe.exists():
        raise TrainingError(f"there is nothing to resume: {run.path} holds no run")
    if run.recipe.exists():
        _check_same(run, recipe, card)


def _check_same(run: RunFolder, recipe: Recipe, card: DatasetCard) -> None:
    differences = recipe_differences(Recipe.from_yaml(run.recipe), recipe)
    differences += [f"dataset {d}" for d in DatasetCard.read(run.card).differences(card)]
    if differences:
        raise TrainingError(
            f"{run.path} was started with another recipe: {'; '.join(differences)}; resume with "
            "the old one, or train into a new folder"
        )


def steps_done(run: RunFolder) -> int:
    """The optimiser steps behind the last checkpoint.

    Raises:
        TrainingError: there is none, or it is damaged.
    """
    path = last_whole(run.last_checkpoint)
    if path is None:
        raise TrainingError(
            f"there is nothing to resume: {run.path} stopped before its first checkpoint; remove "
            "the folder and train anew"
        )
    try:
        return int(read_details(path)["global_step"])
    except (RuntimeError, KeyError, OSError, EOFError, ValueError) as error:
        raise TrainingError(f"{path} cannot be read: {error}") from None


def is_finished(recipe: Recipe, step: int) -> bool:
    """Whether a run that did so many steps has nothing left to do."""
    return 0 < recipe.trainer.get("max_steps", -1) <= step
