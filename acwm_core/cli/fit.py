"""`acwm fit`: trains a world model."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import click

from acwm_core.cli.arguments import OUT_FOLDER, RUN, Dataset

LOOK_S = 0.3
"""For how many seconds the load of the cores is measured."""


def wait_without_spinning() -> None:
    """Let torch's idle threads sleep if other programs use the cores; call before importing torch.

    Spinning is faster on idle cores, but wastes shared ones. If the user has set OMP_WAIT_POLICY or
    OMP_NUM_THREADS, nothing is changed.
    """
    stat = Path("/proc/stat")
    chosen = {"OMP_WAIT_POLICY", "OMP_NUM_THREADS"} & {*os.environ}
    if chosen or "torch" in sys.modules or not stat.exists():
        return
    own = {f"cpu{core}" for core in os.sched_getaffinity(0)}

    def idle_seconds() -> float:
        counts = [line.split() for line in stat.read_text(encoding="utf-8").splitlines()]
        ticks = sum(int(each[4]) + int(each[5]) for each in counts if each[0] in own)
        return ticks / os.sysconf("SC_CLK_TCK")

    before, started = idle_seconds(), time.monotonic()
    time.sleep(LOOK_S)
    busy = len(own) - (idle_seconds() - before) / (time.monotonic() - started)
    if before and busy > 0.5:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


@click.command()
@click.argument("recipe")
@click.argument("overrides", nargs=-1)
@click.option(
    "--out", type=OUT_FOLDER, help="Run folder; runs/RECIPE or runs/RECIPE+small by default."
)
@click.option(
    "--trust-recipe", is_flag=True, help="Execute code that the recipe of a run folder names."
)
def fit(recipe: str, overrides: tuple[str, ...], out: Path | None, trust_recipe: bool) -> None:
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
    from acwm_core.recipe.recipe import compose, refuse_code

    resumed = [each for each in overrides if each.startswith("resume=")]
    others = [each for each in overrides if each not in resumed]
    composed = compose(recipe, others)
    if not trust_recipe:
        refuse_code(Path(recipe))
    resume = resumed[-1].removeprefix("resume=") if resumed else None
    if resume not in (None, "auto"):
        resume = RUN.convert(resume, None, None)
    path, make = composed.data["path"], "`acwm generate ENVIRONMENT` or `acwm data import`"
    if composed.env:
        make = f"`acwm generate {composed.env.name} --out {path}` (for a small model, --size 64)"
    Dataset("dataset", "card.yaml", make).convert(path, None, None)

    wait_without_spinning()
    from acwm_core.training.launch import fit as train  # last: importing torch takes seconds

    overlays = "".join(override for override in others if override.startswith("+"))
    run = train(composed, out or Path("runs", Path(recipe).stem + overlays), resume=resume)
    click.echo(f"trained {run}; next: acwm evaluate {run}")
