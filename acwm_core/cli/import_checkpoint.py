"""`acwm import-checkpoint`: a run folder of a model that another program trained."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.folders import FOLDER, OUT_FOLDER
from acwm_core.errors import CheckpointError


@click.command("import-checkpoint")
@click.argument("file", type=FOLDER)
@click.argument("overrides", nargs=-1)
@click.option("--out", type=OUT_FOLDER, required=True, help="The run folder to make.")
@click.option("--importer", help="Which importer reads it (see `acwm list importer`).")
def import_checkpoint(
    file: Path, overrides: tuple[str, ...], out: Path, importer: str | None
) -> None:
    """Make a run folder of the checkpoint FILE, such as a published latest.pt.

    Nothing that may be pickled in FILE is executed. OVERRIDES change the recipe that it implies:

    \b
      env=push_cube            what its actions mean: an environment,
      data.path=data/mine      or the dataset that it is for
      codec.weights=FILE       where the codec's weights are
      flow.objective=full_sequence     how it was trained, if not by diffusion forcing
      model.heads=8            where the weights don't tell

    `acwm evaluate`, `acwm rollout` and `acwm fit … training.init_from=RUN` take the run.
    """
    if not file.is_file():
        raise CheckpointError(f"there is no file {file}")

    from acwm_core.training.import_checkpoint import import_checkpoint as run_import

    made = run_import(file, out, overrides, importer=importer)
    recipe = made.recipe
    click.echo(
        f"{made.run} holds {recipe.model.name} with {recipe.conditioner.name}, "
        f"{made.parameters / 1e6:.1f} M parameters after {made.step:,} steps, "
        f"on latents of {recipe.codec.name}"
    )
    for note in made.notes:
        click.echo(f"  {note}")
    click.echo(f"next: acwm evaluate {made.run}, with its dataset in {recipe.data['path']}")
