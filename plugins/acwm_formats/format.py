"""Formats of datasets: the interface that plugins implement, and how data is exported by it.

A registered class becomes the commands ``acwm data import NAME`` and, if it can be written, ``acwm
data export NAME``. The parameters of its `read` and `write` become arguments, and keyword-only ones
options. Their help is the ``Args`` section of the method's docstring; the text above it is the
command's description. Supported types are `str`, `int`, `float`, `bool`, `Path`, `Literal`,
``tuple[int, ...]`` (comma-separated numbers) and ``int | tuple[int, int]`` (a frame size), each
optionally with None.
"""

from __future__ import annotations

import inspect
import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.remote import data_folder
from acwm_core.env.episode import Episode, Split
from acwm_core.errors import DataError, MissingExtraError
from acwm_core.executors import progress_bar
from acwm_core.files import check_fetched, made_whole, writing
from acwm_core.plugins import catalog
from acwm_formats.sources import damage_of
from acwm_formats.timeline import RecordedDataset

MOST_LOOKED_AT = 1000  # files whose beginning tells why a format is not known

ARCHIVES = {".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar"}


class Export(NamedTuple):
    """What `Format.write` is given.

    Attributes:
        card: the card of the dataset.
        splits: its splits.
        folder: where to write; it exists and is empty.
        advance: call it once per episode, for the progress bar.
    """

    card: DatasetCard
    splits: dict[Split, EpisodeDataset]
    folder: Path
    advance: Callable[[], None]

    def episodes(self, split: Split) -> Iterator[Episode]:
        """Iterate over the episodes of a split; calls `advance` for each."""
        for episode in self.splits[split]:
            yield episode
            self.advance()


class Format(ABC):
    """A format in which recordings are kept. A subclass reads it, writes it, or both."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether `path` is in this format, told by the names of its files or their first bytes."""
        return False

    def read(self, *source: Any, **options: Any) -> RecordedDataset | Mapping[str, RecordedDataset]:
        """Return the dataset to import, or several, keyed by the subfolder of ``--out`` to fill.

        What every import has, such as frame size, cameras and rate, is not its business: see
        `acwm_formats.reading.ImportOptions`.

        Args:
            source: what to read, usually the one path that `detect` knows.
            options: keyword-only parameters of the subclass.

        Raises:
            DataError: something is missing, damaged or not in this format.
        """
        raise DataError(f"{type(self).__name__} can only be exported, not imported")

    def write(self, export: Export, *args: Any, **options: Any) -> None:
        """Write a whole dataset; an `OSError` is reported to the user in one sentence.

        `read`, if there is one, must read what this writes, given the folder alone.
        """
        raise DataError(f"{type(self).__name__} can only be imported, not exported")

    @classmethod
    @abstractmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """Write a few short recordings into the empty `folder`; return parameters to read them.

        The conformance suite imports these recordings. A format that is only written returns {}.
        """

    @classmethod
    def reads(cls) -> bool:
        """Whether it can be imported."""
        return cls.read is not Format.read

    @classmethod
    def writes(cls) -> bool:
        """Whether it can be exported."""
        return cls.write is not Format.write


def detected_format(path: Path) -> str:
    """The name of the registered format that `path` is in.

    Raises:
        DataError: there is no such path, no format or several know it, or it is damaged.
    """
    if not path.exists():
        raise DataError(f"there is no {path}, and no format of that name: see `acwm list format`")
    matches = _matches(path)
    if len(matches) == 1:
        return matches[0]
    names = ", ".join(matches or (component.name for component in catalog().registry("format")))
    if path.suffix in ARCHIVES:
        raise DataError(f"{path} is an archive: unpack it, and import the folder")
    what = "is in several formats" if matches else "is in no known format"
    raise DataError(f"{path} {what}: give --format, one of {names}")


def _matches(path: Path) -> list[str]:
    """The formats that know `path`; if none does, what is wrong with its files is raised."""
    matches: list[str] = []
    problem: DataError | None = None
    for component in catalog().registry("format"):
        try:
            with damage_of(path):
                if component.load().detect(path):
                    matches.append(component.name)
        except MissingExtraError:
            continue  # it cannot be read here anyway
        except DataError as error:
            problem = problem or error
    if problem and not matches:
        raise problem
    if not matches:
        for file in itertools.islice((path, *path.rglob("*")), MOST_LOOKED_AT):
            if file.is_file():
                check_fetched(file)
    return matches


def export_dataset(
    data: str | Path, out: str | Path, target: Format, *, progress: bool = True, **options: Any
) -> Path:
    """Export the data folder `data` to the folder `out` in another format, whole or not at all.

    Args:
        target: the format.
        options: keyword-only parameters of its `write`.

    Returns:
        The folder `out`.

    Raises:
        DataError: `data` is missing, unfinished or damaged; `out` exists already or cannot be
            written.
    """
    data, out = data_folder(data), Path(out)
    if out.exists():
        raise DataError(f"{out} already exists: choose another --out, or delete it")
    card = DatasetCard.read(data)
    splits: dict[Split, EpisodeDataset] = {s: EpisodeDataset(data, s) for s in card.splits}
    bar = progress_bar("exporting", sum(card.splits.values()), shown=progress)
    with writing(out), made_whole(out) as partial, bar as report:
        target.write(Export(card, splits, partial, lambda: report(1)), **options)
    return out


def options_of(method: Callable[..., Any]) -> list[tuple[inspect.Parameter, str]]:
    """The parameters that a user gives to `Format.read` or `write`, each with its text."""
    parameters = inspect.signature(method, eval_str=True).parameters.values()
    says = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", inspect.getdoc(method) or "", re.M)
    texts = {name: " ".join(text.split()) for name, text in says}
    options = (option for option in parameters if option.name not in ("self", "export"))
    return [(option, texts.get(option.name, "")) for option in options]
