"""`acwm fit`: train a world model from a recipe."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.folders import DATASET, OUT_FOLDER, RUN

RESUME = "resume="


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
      conditioner=cross_attention         another part
      model=dit_s model.layers=4          another part, and one of its parameters
      data.path=data/mine flow.shift=5    any parameter (see `acwm show RECIPE`)
      +small                              the same at small scale, on one device, be it a CPU
      trainer.devices=8 trainer.strategy=fsdp    any flag of Lightning's Trainer
      resume=runs/mine                    go on where that run was stopped
      resume=auto                         resume if there is something to resume, else start

    The run folder holds the recipe in full, checkpoints, logs (tensorboard --logdir runs) and,
    in the end, model.safetensors.
    """
    from acwm_core.recipe import compose

    resumed = [
        override.removeprefix(RESUME) for override in overrides if override.startswith(RESUME)
    ]
    composed = compose(
        recipe, [override for override in overrides if not override.startswith(RESUME)]
    )
    resume = resumed[-1] if resumed else None
    if resume not in (None, "auto"):
        resume = RUN.convert(resume, None, None)
    DATASET.convert(composed.data["path"], None, None)

    from acwm_core.training.launch import fit as train  # last: importing torch takes seconds

    overlays = "".join(override for override in overrides if override.startswith("+"))
    folder = out or Path("runs", Path(recipe).stem + overlays)
    run = train(composed, folder, resume=resume)
    click.echo(f"trained {run}; next: acwm evaluate {run}")
