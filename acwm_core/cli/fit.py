"""`acwm fit`: trains a world model."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, Dataset
from acwm_core.errors import DataError, RecipeError, TrainingError, few
from acwm_core.training.threads import wait_without_spinning

if TYPE_CHECKING:
    from acwm_core.recipe import Recipe

_OVERRIDE = re.compile(r"\+|[\w.]+=")
"""What an override begins with."""


@click.command()
@click.argument("recipe")
@click.argument("overrides", nargs=-1)
@click.option(
    "--out", type=OUT_FOLDER, help="Run folder; runs/RECIPE or runs/RECIPE+small by default."
)
def fit(recipe: str, overrides: tuple[str, ...], out: Path | None) -> None:
    """Train the world model of RECIPE, or continue with resume=RUN.

    RECIPE is a file or the name of a recipe that comes with acwm. OVERRIDES change it:

    \b
      conditioner=cross_attention    another component
      model=dit_s model.layers=4     another one, with a parameter
      data.path=data/mine            any parameter (see `acwm show RECIPE`)
      +small                         the small version: one device, even a CPU
      trainer.devices=8              any flag of Lightning's Trainer
      resume=auto                    continue this command's run if there is one

    `acwm fit resume=RUN` continues a run and takes everything from it, also its length. Overrides
    may change what does not affect the result, and trainer.max_steps.

    The run folder contains the full recipe, checkpoints, logs (tensorboard --logdir runs) and, at
    the end, model.safetensors.
    """
    words = [recipe, *overrides]
    resumed = [word for word in words if word.startswith("resume=")]
    words = [word for word in words if word not in resumed]
    resume = resumed[-1].removeprefix("resume=") if resumed else None
    if resume in (None, "auto"):
        composed, run = _recipe_to_start(words, out, continues=resume is not None)
    else:
        resume = run = RUN.convert(resume, None, None)
        composed = _recipe_to_resume(run, words, out)
    path, make = composed.data["path"], "`acwm generate ENVIRONMENT` or `acwm data import`"
    if composed.env:
        generate = shlex.join(["acwm", "generate", composed.env.name, "--out", str(path)])
        make = f"`{generate}` (for a small model, --size 64)"
    try:
        Dataset("dataset", "card.yaml", make).convert(path, None, None)
    except DataError as error:
        moved = " (if it lies elsewhere now, add data.path=PLACE)" * isinstance(resume, Path)
        raise DataError(f"{error}{moved}") from None

    wait_without_spinning()
    from acwm_core.training.fit import fit as train  # last: importing torch takes seconds

    run = train(composed, run, resume=resume)
    click.echo(f"trained {run}; next: {shlex.join(['acwm', 'evaluate', str(run)])}")


def _recipe_to_start(
    words: Sequence[str], out: Path | None, *, continues: bool
) -> tuple[Recipe, Path]:
    """The recipe of a command's words, and the run folder."""
    from acwm_core.recipe import compose

    if not words:
        raise RecipeError("resume=auto needs the recipe, too; resume=RUN takes it from the run")
    name, *overrides = words
    overlays = "".join(override for override in overrides if override.startswith("+"))
    run, plain = out or Path("runs", Path(name).stem + overlays), compose(name, overrides)
    if continues and not _others(run, plain):
        return plain, run  # begun before its data was looked at, or with another overlay
    return _advised(plain, name, overrides), run


def _advised(plain: Recipe, name: str, overrides: Sequence[str]) -> Recipe:
    """The recipe with the overlay that suits its data; says which, and why."""
    from acwm_core.recipe import compose
    from acwm_core.recipe.advice import advised

    suited, advice = advised(name, overrides)
    if advice is None:
        return plain
    taken = f"{name} +{advice.overlay}" if advice.overlay else f"{name} as it is"
    click.echo(f"{taken}, because {advice.why}; name an overlay for another model")
    return compose(name, suited) if advice.overlay else plain


def _others(run: Path, named: Recipe) -> list[str]:
    """What a recipe says otherwise than the one of a run; something if there is no run."""
    from acwm_core.recipe import Recipe
    from acwm_core.recipe.recipe import recipe_differences
    from acwm_core.training.run_folder import RunFolder

    folder = RunFolder(run)
    if not folder.recipe.is_file():
        return [f"there is no {run}"]
    return recipe_differences(Recipe.from_yaml(folder.recipe), named)


def _recipe_to_resume(run: Path, words: Sequence[str], out: Path | None) -> Recipe:
    """The recipe of a run with overrides.

    Raises:
        RecipeError: a recipe is named and says something else.
        TrainingError: another folder is named.
    """
    from acwm_core.recipe import compose
    from acwm_core.recipe.advice import advised
    from acwm_core.recipe.recipe import differences
    from acwm_core.training.run_folder import RunFolder, resume_command

    folder = RunFolder(run)
    folder.check_resumable()
    if out is not None and out.resolve() != run.resolve():
        raise TrainingError(f"resume={run} continues the run where it is: omit --out {out}")
    has_name = bool(words) and not _OVERRIDE.match(words[0])
    overrides = words[1:] if has_name else words
    kept = compose(folder.recipe, overrides)
    others: list[str] = []
    if has_name and (others := differences(kept, compose(words[0], overrides), only_set=True)):
        suited, _ = advised(words[0], overrides)
        others = differences(kept, compose(words[0], suited), only_set=True)
    if others:
        raise RecipeError(
            f"the recipe {words[0]} is not the one of {run}: {few(others)}; leave it out, "
            f"`{resume_command(folder)}` continues the run as it was"
        )
    return kept
