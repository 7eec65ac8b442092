"""`acwm data import` and `acwm data export`: datasets of other formats, and from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import FOLDER
from acwm_core.cli.size import SIZE
from acwm_core.errors import DataError

if TYPE_CHECKING:
    from acwm_core.data.exchange import Source

Size = int | tuple[int, int] | None

ROOT = click.Path(path_type=Path)
out_option = click.option("--out", type=FOLDER, required=True, help="The data folder to make.")
size_option = click.option(
    "--size", type=SIZE, help="Frame size, 64 or HEIGHTxWIDTH; by default that of the videos."
)
name_option = click.option("--environment", help="What to call the environment.")
workers_option = click.option(
    "--workers", type=int, help="Processes; one per core by default, 0 for none."
)


@click.group("import")
def import_group() -> None:
    """Make a dataset of recordings in another format.

    Interrupted, the same command goes on where it stopped.
    """


@import_group.command("acwm-phys")
@click.argument("root", type=ROOT)
@out_option
@size_option
@name_option
@workers_option
def import_published(
    root: Path, out: Path, size: Size, environment: str | None, workers: int | None
) -> None:
    """Import the published ACWM-Phys release.

    ROOT is the folder of one environment, which becomes the dataset OUT, or a folder of several,
    each of which becomes a dataset OUT/NAME. Videos of 1024×1024 become 240×240 unless --size says
    otherwise.
    """
    from acwm_core.data.exchange.from_published import published_folders, published_source

    folders = published_folders(root)
    if environment and len(folders) > 1:
        raise DataError(
            f"{root} holds {len(folders)} environments: give --environment for one folder at a time"
        )
    for folder in folders:
        source = published_source(folder, environment=environment, size=size)
        several = folders != [root]
        _import(source, out / source.environment.name if several else out, workers)


def _import(source: Source, out: Path, workers: int | None) -> None:
    from acwm_core.data.exchange import import_dataset

    card = import_dataset(source, out, workers=workers)
    made = ", ".join(f"{count} {split}" for split, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {card.environment.name}")
    for note in card.source["notes"]:
        click.echo(f"  {note}")
    click.echo(f"next: acwm fit small data.path={out}")
