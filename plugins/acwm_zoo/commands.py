"""`acwm ship` and `acwm push`: turn a run into a trained model, for a package or for the Hub."""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER, RUN
from acwm_core.errors import TrainingError


@click.command()
@click.argument("run", type=RUN)
@click.argument("overrides", nargs=-1)
@click.option(
    "--out", type=OUT_FOLDER, required=True, help="Folder to create; its name is the model's name."
)
@click.option("--data", type=DATASET, help="Dataset for the scores; the recipe's by default.")
def ship(run: Path, overrides: tuple[str, ...], out: Path, data: Path | None) -> None:
    """Package RUN as a small trained model.

    Writes the weights in bfloat16, the recipe, and a model card with learning curve and scores of
    these weights. OVERRIDES change the evaluation. A package can register the folder as a trained
    model.
    """
    from acwm_zoo.packing import pack

    made = pack(run, out, overrides=overrides, data=data)
    size = sum(file.stat().st_size for file in made.rglob("*") if file.is_file())
    click.echo(
        f"{made}: {size / 1e6:.1f} MB; its card is {made / 'README.md'}; "
        f"next: acwm rollout {shlex.quote(str(made))}"
    )


@click.command()
@click.argument("run", type=RUN)
@click.argument("address", metavar="hf://ORG/NAME")
@click.argument("overrides", nargs=-1)
@click.option("--data", type=DATASET, help="Dataset for the scores; the recipe's by default.")
def push(run: Path, address: str, overrides: tuple[str, ...], data: Path | None) -> None:
    """Publish RUN on the Hugging Face Hub, for `acwm rollout hf://ORG/NAME`.

    Creates the repository, packages the run as `acwm ship` does and uploads the result. OVERRIDES
    change the evaluation. Run `hf auth login` before.
    """
    from acwm_core.plugins import catalog

    repository = address.removeprefix("hf://")
    if repository == address or repository.count("/") != 1 or "@" in repository:
        raise TrainingError(f"{address} is not a place to publish to: write hf://ORG/NAME")
    catalog().component("trained_model", "hf").load()  # reports missing packages before any work
    from acwm_zoo.hub import create, publish
    from acwm_zoo.packing import pack

    page = create(repository)  # so that a wrong address costs no evaluation
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder, "model")
        pack(run, made, name=address, overrides=overrides, data=data)
        publish(made, repository)
    click.echo(page)
