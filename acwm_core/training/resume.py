"""The lock on the run folder of a training, and the checkpoint from which it resumes."""

from __future__ import annotations

import contextlib
import shlex
import shutil
from collections.abc import Generator
from pathlib import Path
from typing import Any, cast

import lightning as L
from lightning.pytorch.utilities import rank_zero_only

from acwm_core.data.card import DatasetCard
from acwm_core.errors import TrainingError, few
from acwm_core.files import held, written_whole
from acwm_core.recipe import Recipe, recipe_differences
from acwm_core.training.checkpoints import check_sums, last_whole
from acwm_core.training.precision import with_recorded_precision
from acwm_core.training.run_folder import RunFolder, resume_command
from acwm_core.training.signals import StoppedEarly

AUTO = "auto"
"""Value of `resume`: resume if there is something to resume, else start a new run."""


def is_first_process() -> bool:
    """Whether this is the process that writes files and reports errors, of all that train."""
    return cast(Any, rank_zero_only).rank == 0


@contextlib.contextmanager
def claimed(run: RunFolder) -> Generator[None]:
    """Lock the run folder while the first process trains; remove a new one that got no recipe."""
    if not is_first_process():
        yield
        return
    is_new = not run.path.exists()
    run.path.mkdir(parents=True, exist_ok=True)
    try:
        with held(run.path):
            yield
    finally:
        if is_new and not run.recipe.exists():
            shutil.rmtree(run.path, ignore_errors=True)


def checkpoint_to_resume(
    run: RunFolder, recipe: Recipe, card: DatasetCard, resume: Path | str | None
) -> Path | None:
    """The checkpoint to resume from, or None to start.

    The first process refuses a folder that holds another run, or a run that this recipe and data
    cannot resume.
    """
    run.check_links()
    last = last_whole(run.last_checkpoint)
    if not is_first_process():
        return None if resume is None else last
    run.check_resumable()
    if not run.recipe.exists():
        if last or resume not in (None, AUTO):
            raise TrainingError(f"there is nothing to resume: {run.path} holds no run")
        return None
    if resume is None:
        raise TrainingError(
            f"{run.path} holds a run already: continue it with `{resume_command(run)}`, or choose "
            "another --out"
        )
    differences = _differences(run, recipe, card, last)
    if differences:
        start = shlex.quote(f"training.init_from={run.path}")
        raise TrainingError(
            f"{run.path} was started with another recipe: {few(differences)}; "
            f"`{resume_command(run)}` continues it as it was, {start} starts "
            "another run from its weights"
        )
    if last is not None:
        check_sums(last)
    return last


def _differences(run: RunFolder, recipe: Recipe, card: DatasetCard, last: Path | None) -> list[str]:
    """What a resumed run would change; the same data may lie in another place."""
    started = Recipe.from_yaml(run.recipe)
    if last is not None:
        recipe = with_recorded_precision(recipe, started, last)
        started = with_recorded_precision(started, started, last)
    changes = recipe_differences(started, recipe)
    changes = [change for change in changes if not change.startswith("data.path ")]
    before = DatasetCard.read(run.card)
    if before.has_data_of(card):
        scene = before.environment.contradictions(card.environment)
        return [
            *changes,
            *(f"the dataset's card says otherwise of its {name} now" for name in scene),
        ]
    others = [change for change in before.differences(card) if not change.startswith("source.")]
    why = few(others, 1) if others else "other recordings"
    return [*changes, f"{recipe.data['path']} holds other data ({why})"]


@contextlib.contextmanager
def described(
    run: RunFolder, recipe: Recipe, card: DatasetCard, is_new: bool, module: L.LightningModule
) -> Generator[None]:
    """Write recipe and card into the run folder, if this is the first process.

    If a new run fails before its first step, both are removed, so that it can be fixed and started
    again in the same folder.
    """
    if not is_first_process():
        yield
        return
    run.checkpoints.mkdir(exist_ok=True)
    with written_whole(run.recipe) as partial:
        partial.write_text(recipe.to_yaml(), encoding="utf-8")
    card.write(run.path)
    try:
        yield
    except Exception as error:
        if is_new and module.global_step == 0 and not isinstance(error, (StoppedEarly, OSError)):
            run.recipe.unlink(missing_ok=True)
            run.card.unlink(missing_ok=True)
        raise
