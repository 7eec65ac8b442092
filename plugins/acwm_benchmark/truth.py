"""Where the true test data of a benchmark lies, and how it is simulated if it lies nowhere."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from acwm_benchmark.tasks import BenchmarkWorld
from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.episode import SPLITS, Split
from acwm_core.errors import DataError
from acwm_core.evaluation.evaluate import open_splits
from acwm_core.files import inside

TESTS: tuple[Split, ...] = tuple(split for split in SPLITS if split != "train")


def truth_beside(tasks: Path) -> Path:
    """The folder of the true data of a folder of tasks, if nobody names another."""
    tasks = tasks.resolve()
    return tasks.with_name(f"{tasks.name}-truth")


def datasets_in(folder: Path) -> dict[str, Path]:
    """The datasets by world: of a folder that holds some, or is one."""
    places = [folder] if (folder / CARD).is_file() else sorted(folder.glob("*/"))
    found: dict[str, Path] = {}
    for place in places:
        if (place / CARD).is_file():
            name = DatasetCard.read(place).environment.name
            if name in found:
                raise DataError(f"{found[name]} and {place} both hold {name}: name one of them")
            found[name] = place
    return found


def truth_of(
    world: BenchmarkWorld, folder: Path, workers: int | None, progress: bool
) -> dict[str, EpisodeDataset]:
    """The true test splits of a world; simulated into `folder` if they are not there.

    Raises:
        DataError: they are not there and cannot be simulated, or are others than the tasks are of.
    """
    path = datasets_in(folder).get(world.name)
    if path is None:
        path = _simulated(world, folder, workers, progress)
    card = DatasetCard.read(path).environment
    datasets = open_splits(path, list(world.checksums), card)
    for split, each in datasets.items():
        if each.checksum != world.checksums[split]:
            raise DataError(
                f"{path} holds other episodes of {split} than "
                f"the tasks ({each.checksum[:8]}, not {world.checksums[split][:8]}): give the "
                "organiser's "
                "data with --data, or simulate it on the same kind of processor with the "
                "same versions"
            )
    return datasets


def _simulated(world: BenchmarkWorld, folder: Path, workers: int | None, progress: bool) -> Path:
    if world.source:
        recorded = f"{world.source['kind']} {world.source['name']}"
        raise DataError(
            f"{folder} holds no {world.name}, and recorded data ({recorded}) cannot be simulated: "
            "import it and name it with --data"
        )
    if world.seed is None:
        raise DataError(
            f"{folder} holds no {world.name}, and the seed of its tasks is secret: only the "
            "organiser can score them, who names the data with --data"
        )
    place = inside(folder, world.name)
    simulate(world.name, place, world.episodes, world.size, world.seed, workers, progress)
    return place


def simulate(
    name: str,
    out: Path,
    episodes: Mapping[str, int],
    size: tuple[int, int] | int | None,
    seed: int,
    workers: int | None,
    progress: bool,
) -> None:
    """Simulate the test splits of a world."""
    counts: dict[Split, int] = {split: episodes[split] for split in TESTS if split in episodes}
    generate(name, out, episodes=counts, size=size, seed=seed, workers=workers, progress=progress)
