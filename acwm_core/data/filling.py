"""Filling a data folder with shards, whatever makes them: resumable, one writer at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from acwm_core.data.atomic import held, remove_partial
from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.manifest import Manifest, ShardRecord, action_statistics, shard_name
from acwm_core.data.readme import write_readme
from acwm_core.episode import SPLITS, Split
from acwm_core.errors import DataError, OtherDatasetError
from acwm_core.executors import Executor, Report

MEASURED = 600.0
"""Seconds over which the rate is taken: several episodes even of a slow environment."""

Manifests = dict[Split, Manifest]
Value = TypeVar("Value")
Task = TypeVar("Task")

MakeTask = Callable[[Path, Split, int, int], Task]
"""From a shard's path, its split, the index of its first episode and their number to its task."""

MakeShard = Callable[[Task, Report], tuple[Split, ShardRecord]]
"""Makes the shard of a task, on whatever executor, and describes it."""


def fill(
    out: Path,
    wanted: DatasetCard,
    make_task: MakeTask[Task],
    make_shard: MakeShard[Task],
    executor: Executor,
    *,
    progress: bool = True,
) -> DatasetCard:
    """Make the shards of the dataset `wanted` that the folder `out` does not hold yet.

    Finished shards are kept, so the same call goes on where a killed one ended, and a call for
    another split adds it to the folder.

    Args:
        out: the folder; created with its parents.
        wanted: the card of what is to be made.
        make_task: describes one shard to make.
        make_shard: makes it; importable and picklable, as tasks are.
        executor: runs `make_shard` over the tasks.
        progress: show a progress bar on the terminal.

    Returns:
        The card of the folder, with the statistics of its actions.

    Raises:
        DataError: the folder holds another dataset, is in use, or a shard could not be made.
    """
    _make_folder(out)
    with writing(out), held(out):
        return _fill(out, wanted, make_task, make_shard, executor, progress)


@contextlib.contextmanager
def writing(out: Path) -> Generator[None]:
    """Tell what the system says against writing to `out` as a `DataError`."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"cannot write to {out} ({error.strerror}): make room or allow it, and run the same "
            "command again to go on"
        ) from error


def _fill(
    out: Path,
    wanted: DatasetCard,
    make_task: MakeTask[Task],
    make_shard: MakeShard[Task],
    executor: Executor,
    progress: bool,
) -> DatasetCard:
    remove_partial(out)
    there = DatasetCard.read(out) if (out / CARD).exists() else wanted
    differences = there.differences(wanted)
    _refuse(out, [each for each in differences if not each.startswith("versions.")])
    manifests: Manifests = {split: _open_manifest(out, split) for split in wanted.splits}
    missing = _missing_shards(out, wanted, manifests)
    joined = replace(there, splits=_in_order({**there.splits, **wanted.splits}))
    if missing:
        _refuse(out, differences)  # other versions matter only to what is still to be made
        joined.write(out)  # a folder with shards always says what they are
        tasks = [make_task(*shard) for shard in missing]
        todo = sum(count for *_, count in missing)
        try:
            with _progress_bar(wanted, todo, progress) as report:
                for split, record in executor.run(make_shard, tasks, report):
                    manifests[split].add(record)
        finally:
            for manifest in manifests.values():
                remove_partial(manifest.path.parent)  # of workers that died
    return _finish(out, joined, manifests)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        names = [path.name for path in out.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise DataError(f"cannot make the folder {out} ({error.strerror})") from error
    if names and CARD not in names:
        raise DataError(
            f"{out} holds other files ({names[0]}) and no dataset: choose another --out"
        )


def _refuse(out: Path, differences: list[str]) -> None:
    if differences:
        raise OtherDatasetError(out, differences)


def _in_order(values: Mapping[Split, Value]) -> dict[Split, Value]:
    return {split: values[split] for split in SPLITS if split in values}


def _open_manifest(out: Path, split: Split) -> Manifest:
    folder = out / split
    folder.mkdir(exist_ok=True)
    remove_partial(folder)
    return Manifest(folder)


def _missing_shards(
    out: Path, card: DatasetCard, manifests: Manifests
) -> list[tuple[Path, Split, int, int]]:
    missing: list[tuple[Path, Split, int, int]] = []
    for split in manifests:
        for number, first in enumerate(range(0, card.splits[split], card.shard_episodes)):
            path = out / split / shard_name(number)
            if manifests[split].has(path.name):
                continue
            if path.name in manifests[split].records:
                path.unlink(missing_ok=True)  # not the file that was recorded
            missing.append(
                (path, split, first, min(card.shard_episodes, card.splits[split] - first))
            )
    return missing


@contextlib.contextmanager
def _progress_bar(card: DatasetCard, todo: int, shown: bool) -> Generator[Report]:
    """A bar over all episodes with the rate and the remaining time of this run."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    total = sum(card.splits.values())
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes {task.fields[rate]}"),
        Remaining(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, disable=not shown, speed_estimate_period=MEASURED
    ) as bar:
        name = card.environment.name
        task_id = bar.add_task(name, total=total, completed=total - todo, rate="")

        def report(episodes: int) -> None:
            bar.advance(task_id, episodes)
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
            bar.update(task_id, rate=_rate(speed) if speed else "")

        yield report


def _rate(speed: float) -> str:
    return f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min"


def _finish(out: Path, card: DatasetCard, manifests: Manifests) -> DatasetCard:
    statistics, checksums = dict(card.actions), dict(card.checksums)
    for split, manifest in manifests.items():
        manifest.finish()
        statistics[split] = action_statistics(manifest.ordered())
        checksums[split] = manifest.checksum()
    card = replace(card, actions=_in_order(statistics), checksums=_in_order(checksums))
    card.write(out)
    write_readme(out, card)
    return card
