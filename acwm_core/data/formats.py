"""Datasets in other formats: the interfaces of importers and exporters.

A registered class becomes the command ``acwm data import NAME`` or ``acwm data export NAME``. Its
positional parameters become arguments and its keyword-only parameters options. Their help is the
``Args`` section of the class's docstring; the text above it is the command's description. Supported
types are `str`, `int`, `float`, `bool`, `Path`, `Literal`, ``tuple[int, ...]`` (comma-separated
numbers) and ``int | tuple[int, int]`` (a frame size), each optionally with None.
"""

from __future__ import annotations

import inspect
import re
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

from acwm_core.data.atomic import made_whole, writing
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.recordings import RecordedDataset
from acwm_core.data.remote import data_folder
from acwm_core.env.episode import Episode, Split
from acwm_core.errors import DataError
from acwm_core.executors import progress_bar


class DatasetImporter(ABC):
    """Reads recordings of some format, e.g. a frozen dataclass whose fields are its parameters."""

    @abstractmethod
    def read(self) -> RecordedDataset | Mapping[str, RecordedDataset]:
        """Return the dataset to import, or several, keyed by the subfolder of ``--out`` to fill.

        Raises:
            DataError: something is missing, damaged or not in this format.
        """

    @classmethod
    @abstractmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """Write a few short recordings into the empty `folder`; return parameters to read them.

        The conformance suite imports these recordings.
        """


class Export(NamedTuple):
    """What an exporter is given.

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


class DatasetExporter(ABC):
    """Writes datasets in some format.

    If an importer is registered under the same name, it must read what this writes: its first
    parameter is the folder, and all others have defaults.
    """

    @abstractmethod
    def write(self, export: Export) -> None:
        """Write a whole dataset; an `OSError` is reported to the user in one sentence."""


def export_dataset(
    data: str | Path, out: str | Path, exporter: DatasetExporter, *, progress: bool = True
) -> Path:
    """Export the data folder `data` to the folder `out` in another format, whole or not at all.

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
        exporter.write(Export(card, splits, partial, lambda: report(1)))
    return out


def import_command(kind: str, name: str, **options: object) -> str:
    """The command ``acwm data import KIND NAME --option value …``; options of None are left out."""
    words = ["acwm", "data", "import", kind, name]
    for option, value in options.items():
        if value is not None:
            size = "x".join(map(str, cast(Any, value))) if isinstance(value, tuple) else value
            words += [f"--{option.replace('_', '-')}", str(size)]
    return shlex.join(words)


def options_of(component: Callable[..., Any]) -> list[tuple[inspect.Parameter, str]]:
    """The parameters of an importer or exporter, each with its text from the docstring."""
    parameters = inspect.signature(component, eval_str=True).parameters.values()
    says = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", inspect.getdoc(component) or "", re.M)
    texts = {name: " ".join(text.split()) for name, text in says}
    return [(parameter, texts.get(parameter.name, "")) for parameter in parameters]
