"""`acwm data import` and `acwm data export`: datasets of other formats, and from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.folders import DATASET, OUT_FOLDER
from acwm_core.cli.size import SIZE
from acwm_core.errors import DataError, RecipeError

if TYPE_CHECKING:
    from acwm_core.data.exchange import Source
    from acwm_core.episode import Split

Size = int | tuple[int, int] | None

ROOT = click.Path(path_type=Path)
out_option = click.option("--out", type=OUT_FOLDER, required=True, help="The data folder to make.")
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


@import_group.command("lerobot")
@click.argument("root", type=ROOT)
@out_option
@click.option("--camera", help="Which camera; the first by default.")
@click.option(
    "--test-episodes",
    type=click.IntRange(0),
    help="How many of the last episodes become ind_test; by default the dataset's own test splits, "
    "or else a tenth.",
)
@size_option
@name_option
@workers_option
def import_lerobot(root: Path, out: Path, workers: int | None, **options: Any) -> None:
    """Import the LeRobot dataset in the folder ROOT, of version 3.0 or 2.x.

    Frames of one camera, actions, and what was observed as numbers.
    """
    from acwm_core.data.exchange.from_lerobot import lerobot_source

    _import(lerobot_source(root, **options), out, workers)


@import_group.command("gymnasium")
@click.argument("env_id", metavar="ENV_ID")
@out_option
@click.option(
    "--episodes",
    required=True,
    help="How many: 100, or 100,10 for train and ind_test; a tenth more for ind_test by default.",
)
@click.option(
    "--policy",
    default="random",
    show_default=True,
    help="Who acts: random, or module:function of an observation and a random generator.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the dataset.")
@click.option(
    "--frames",
    type=click.IntRange(2),
    default=1000,
    show_default=True,
    help="End episodes after so many frames.",
)
@size_option
@name_option
@workers_option
def import_gymnasium(
    env_id: str, out: Path, episodes: str, workers: int | None, **options: Any
) -> None:
    """Import rollouts of the Gymnasium environment ENV_ID.

    It is rendered with render_mode="rgb_array"; module:Name-v0 imports a module first.
    """
    counts = _counts(episodes)

    from acwm_core.data.exchange.from_gymnasium import gymnasium_source

    _import(gymnasium_source(env_id, episodes=counts, **options), out, workers)


@click.command("export")
@click.argument("form", metavar="FORMAT", type=click.Choice(["acwm-phys", "lerobot", "hdf5"]))
@click.argument("path", type=DATASET, metavar="DATA")
@click.option("--out", type=OUT_FOLDER, required=True, help="The folder to make.")
def export(form: str, path: Path, out: Path) -> None:
    """Write the dataset DATA in another format.

    acwm-phys is the layout of the published release, lerobot a LeRobot dataset of version 3.0;
    both have visually lossless video. hdf5 keeps every bit and the ground truth.
    """
    from acwm_core.data.exchange.exporting import export_dataset

    if form == "acwm-phys":
        from acwm_core.data.exchange.to_published import write_published as exporter
    elif form == "lerobot":
        from acwm_core.data.exchange.to_lerobot import write_lerobot as exporter
    else:
        from acwm_core.data.exchange.to_hdf5 import write_hdf5 as exporter
    click.echo(f"wrote {export_dataset(path, out, exporter)}")


def _counts(text: str) -> dict[Split, int]:
    """Episodes per split of ``--episodes``."""
    numbers = text.split(",")
    if not all(number.isdigit() for number in numbers) or len(numbers) > 2:
        raise RecipeError(f"--episodes {text}: give a number such as 100, or 100,10")
    train, *test = map(int, numbers)
    return {"train": train, "ind_test": test[0] if test else max(2, train // 10)}


def _import(source: Source, out: Path, workers: int | None) -> None:
    from acwm_core.data.exchange import import_dataset

    card = import_dataset(source, out, workers=workers)
    made = ", ".join(f"{count} {split}" for split, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {card.environment.name}")
    for note in card.source["notes"]:
        click.echo(f"  {note}")
    click.echo(f"next: acwm fit small data.path={out}")
