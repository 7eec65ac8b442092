"""`acwm fit`: train a world model from a recipe."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.folders import DATASET, FOLDER, RUN

RESUME = "resume="


@click.command()
@click.argument("recipe")
@click.argument("words", nargs=-1)
@click.option("--out", type=FOLDER, help="Run folder; runs/RECIPE by default.")
def fit(recipe: str, words: tuple[str, ...], out: Path | None) -> None:
    """Train the world model of RECIPE.

    RECIPE is a file or the name of a recipe that comes with acwm. WORDS change it:

    \b
      conditioner=cross_attention         another part
      model=dit_s model.layers=4          another part, and one of its parameters
      data.path=data/mine flow.shift=5    any parameter (see `acwm show RECIPE`)
      trainer.devices=8 trainer.strategy=ddp     any flag of Lightning's Trainer
      resume=runs/mine                    go on where that run was stopped

    The run folder holds the recipe in full, checkpoints, logs (tensorboard --logdir runs) and,
    in the end, model.safetensors.
    """
    from acwm_core.recipe import compose

    resumed = [word.removeprefix(RESUME) for word in words if word.startswith(RESUME)]
    composed = compose(recipe, [word for word in words if not word.startswith(RESUME)])
    resume = RUN.convert(resumed[-1], None, None) if resumed else None
    DATASET.convert(composed.data["path"], None, None)

    from acwm_core.training.launch import fit as train  # last: importing torch takes seconds

    folder = out or Path("runs", Path(recipe).stem)
    run = train(composed, folder, resume=resume)
    click.echo(f"trained {run}; next: acwm evaluate {run}")
