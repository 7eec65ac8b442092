"""`acwm fit`: trains a world model."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, Dataset
from acwm_core.training.threads import wait_without_spinning


@click.command()
@click.argument("recipe")
@click.argument("overrides", nargs=-1)
@click.option(
    "--out", type=OUT_FOLDER, help="Run folder; runs/RECIPE or runs/RECIPE+small by default."
)
def fit(recipe: str, overrides: tuple[str, ...], out: Path | None) -> None:
    """Train the world model of RECIPE.

    RECIPE is a file or the name of a recipe that comes with acwm. OVERRIDES change it:

    \b
      conditioner=cross_attention    another component
      model=dit_s model.layers=4     another one, with a parameter
      data.path=data/mine            any parameter (see `acwm show RECIPE`)
      +small                         the small version: one device, even a CPU
      trainer.devices=8              any flag of Lightning's Trainer
      resume=runs/mine               continue that run
      resume=auto                    continue if there is a checkpoint

    The run folder contains the full recipe, checkpoints, logs (tensorboard --logdir runs) and, at
    the end, model.safetensors.
    """
    from acwm_core.recipe import compose

    resumed = [each for each in overrides if each.startswith("resume=")]
    others = [each for each in overrides if each not in resumed]
    composed = compose(recipe, others)
    resume = resumed[-1].removeprefix("resume=") if resumed else None
    if resume not in (None, "auto"):
        resume = RUN.convert(resume, None, None)
    path, make = composed.data["path"], "`acwm generate ENVIRONMENT` or `acwm data import`"
    if composed.env:
        make = f"`acwm generate {composed.env.name} --out {path}` (for a small model, --size 64)"
    Dataset("dataset", "card.yaml", make).convert(path, None, None)

    wait_without_spinning()
    from acwm_core.training.fit import fit as train  # last: importing torch takes seconds

    overlays = "".join(override for override in others if override.startswith("+"))
    run = train(composed, out or Path("runs", Path(recipe).stem + overlays), resume=resume)
    click.echo(f"trained {run}; next: acwm evaluate {run}")
