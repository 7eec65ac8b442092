"""`acwm new KIND NAME`: write a package with a working component, under a name of your choice."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from acwm_core.cli.arguments import FOLDER, OUT_FOLDER
from acwm_templates.kinds import KINDS


@click.command()
@click.argument("kind", type=click.Choice([*KINDS]), metavar="KIND")
@click.argument("name")
@click.option("--out", type=OUT_FOLDER, help="Folder to make; acwm_NAME by default.")
@click.option(
    "--environment", default="push_cube", help="Of a task: the environment that it is for."
)
@click.option("--weights", type=FOLDER, help="Of an estimator: a file of `acwm train-estimator`.")
@click.option(
    "--from-gym",
    "gym",
    metavar="ID",
    help="Of an environment: one of Gymnasium to wrap, as in gymnasium.make; module:Name-v0 "
    "imports a module first.",
)
def new(
    kind: str,
    name: str,
    out: Path | None,
    environment: str,
    weights: Path | None,
    gym: str | None,
) -> None:
    """Start your own plugin.

    Writes a working package with a component called NAME (in snake_case) and tests; change it
    piece by piece. KIND is one of:

    \b
      environment   a world simulated and drawn with numpy, or one of Gymnasium (--from-gym)
      scene         a world in 3-D: MuJoCo and the renderer of acwm
      codec         video to latents and back
      model         predicts latents
      conditioner   brings actions into a model
      objective     how a model learns, and how it predicts
      metric        scores predicted video
      estimator     reads states from frames; NAME is that of the world
      task          a goal in an environment, with a distance and success
      planner       chooses actions
    """
    from acwm_templates.package import package_of, write_package

    place = out or Path(package_of(kind, name))
    folder = write_package(kind, name, place, environment, weights, gym)
    checked = f"{environment}.{name}" if kind == "task" else name
    place = shlex.quote(str(folder))
    click.echo(f"made {folder}; next: pip install -e {place} && acwm check {checked}")
