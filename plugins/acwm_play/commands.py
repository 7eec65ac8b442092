"""`acwm play`: a page on which a person acts in the simulator and the model at the same time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import FOLDER, OUT_FOLDER, RUN, size
from acwm_core.errors import RecipeError
from acwm_core.training.threads import wait_without_spinning


@click.command()
@click.argument("runs", type=RUN, nargs=-1, metavar="[RUN]...")
@click.option("--env", "environment", metavar="NAME", help="World; RUN's by default.")
@click.option(
    "--size", "frame_size", type=size, metavar="SIDE", help="Frame size; RUN's by default."
)
@click.option("--steps", type=click.IntRange(1), help="Sampling steps; the recipe's by default.")
@click.option(
    "--out",
    type=OUT_FOLDER,
    default=Path("runs", "play"),
    help="Folder for recordings: a dataset per world, and videos.",
)
@click.option("--port", type=click.IntRange(1, 65535), help="Port of the page.  [default: 8426]")
@click.option("--browser/--no-browser", default=True, help="Open the page.")
@click.option(
    "--export",
    "folder",
    type=OUT_FOLDER,
    help="Write a page that needs no server to this folder instead.",
)
@click.option(
    "--runtime",
    type=FOLDER,
    help="For --export: folder of the npm package onnxruntime-web; fetched by npm by default.",
)
def play(runs: tuple[Path, ...], **options: Any) -> None:
    """Play with the model of RUN beside the simulator, in a browser.

    Both start from the same frame and receive your actions from keyboard, mouse, touch or gamepad.
    A model of recorded data has the recorded video beside it, which does not follow your actions.
    Several runs make a menu; without RUN, it shows the installed trained models. Only this machine
    can open the page. Ctrl-C stops it.
    """
    wait_without_spinning()
    from acwm_play.serve import serve
    from acwm_play.worlds import playable

    port, browser = options.pop("port"), options.pop("browser")
    out, steps = options.pop("out"), options.pop("steps")
    folder, package = options.pop("folder"), options.pop("runtime")
    if folder and len(runs) != 1:
        raise RecipeError("--export writes the page of one run: name one")
    worlds = playable(runs, **options)
    if recorded := dict.fromkeys(world.environment for world in worlds if world.data):
        gone = "the simulator, factors, tasks, errors of states and recording"
        click.echo(f"not available for recorded data ({', '.join(recorded)}): {gone}")
    if folder and worlds[0].data:
        raise RecipeError(f"--export needs a simulator, but {worlds[0].environment} is recorded")
    if folder:
        from acwm_play.export.page import export

        click.echo(f"open {export(worlds[0], folder, package)} in a browser")
        return
    serve(worlds, out=out, steps=steps, port=port, browser=browser)
