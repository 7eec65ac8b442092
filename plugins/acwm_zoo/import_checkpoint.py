"""`acwm import-checkpoint`."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from acwm_core.cli.arguments import FOLDER, OUT_FOLDER
from acwm_core.errors import DataError


@click.command("import-checkpoint")
@click.argument("file", type=FOLDER)
@click.argument("overrides", nargs=-1)
@click.option("--out", type=OUT_FOLDER, required=True, help="Run folder to create.")
@click.option("--importer", help="Importer to use (see `acwm list importer`).")
def import_checkpoint(
    file: Path, overrides: tuple[str, ...], out: Path, importer: str | None
) -> None:
    """Convert a published checkpoint to a run folder.

    FILE is a checkpoint of another program, such as a published latest.pt; pickled code in it is
    not executed. OVERRIDES change the recipe:

    \b
      env=push_cube                   meaning of the actions: an environment,
      data.path=data/mine             or a dataset
      codec.weights=FILE              weights of the codec
      objective=full_sequence         if not trained by diffusion forcing
      model.heads=8                   if not known from the weights

    `acwm evaluate`, `acwm rollout` and `acwm fit … training.init_from=RUN` accept the run.
    """
    if not file.is_file():
        raise DataError(f"there is no file {file}")

    from acwm_zoo.importing import import_checkpoint as run_import

    imported = run_import(file, out, overrides, importer=importer)
    recipe = imported.recipe
    click.echo(
        f"{imported.run} holds {recipe.model.name} with {recipe.conditioner.name}, "
        f"{imported.parameters / 1e6:.1f} M parameters after {imported.step:,} steps, "
        f"on latents of {recipe.codec.name}"
    )
    for note in imported.notes:
        click.echo(f"  {note}")
    evaluate = shlex.join(["acwm", "evaluate", str(imported.run)])
    click.echo(f"next: {evaluate}, with its dataset in {recipe.data['path']}")
