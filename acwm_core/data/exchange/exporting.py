"""From a data folder to another format: whole or not at all, one episode in memory at a time."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import NamedTuple

from acwm_core.data.card import DatasetCard
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.remote import data_folder
from acwm_core.episode import Episode, Split
from acwm_core.errors import DataError


class Export(NamedTuple):
    """What an exporter is given.

    Attributes:
        card: of the dataset.
        splits: its splits.
        folder: where to write; it exists and is empty.
        advance: to be called once per episode.
    """

    card: DatasetCard
    splits: dict[Split, EpisodeDataset]
    folder: Path
    advance: Callable[[], None]

    def episodes(self, split: Split) -> Iterator[Episode]:
        """The episodes of a split, counted as they come."""
        for episode in self.splits[split]:
            yield episode
            self.advance()


def export_dataset(
    data: str | Path,
    out: str | Path,
    exporter: Callable[[Export], None],
    *,
    progress: bool = True,
) -> Path:
    """Write the data folder `data` as `out` in the format of `exporter`.

    Args:
        data: the data folder, or its URL; it must be finished.
        out: the folder to make.
        exporter: e.g. `write_lerobot`.
        progress: show a progress bar on the terminal.

    Returns:
        The folder.

    Raises:
        DataError: `data` is missing, unfinished or damaged; `out` is there already or cannot be
            written.
    """
    data, out = data_folder(data), Path(out)
    card = DatasetCard.read(data)
    splits: dict[Split, EpisodeDataset] = {s: EpisodeDataset(data, s) for s in card.splits}
    with _made_whole(out) as folder, _progress_bar(sum(map(len, splits.values())), progress) as bar:
        exporter(Export(card, splits, folder, bar))
    return out


@contextlib.contextmanager
def _made_whole(out: Path) -> Generator[Path]:
    """A folder to write to, which becomes `out` at the end, or vanishes if something fails."""
    if out.exists():
        raise DataError(f"{out} is there already: choose another --out, or delete it")
    partial = out.with_name(f".{out.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)  # of one that was killed
        partial.mkdir(parents=True)
        yield partial
        partial.replace(out)
    except OSError as error:
        raise DataError(f"cannot write {out} ({error.strerror or error})") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def _progress_bar(episodes: int, shown: bool) -> Generator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    columns = (TextColumn("exporting"), BarColumn(), MofNCompleteColumn(), Remaining())
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as bar:
        task = bar.add_task("", total=episodes)
        yield lambda: bar.advance(task)
