"""Folders named on the command line, looked for before anything heavy is imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from acwm_core.data.atomic import writable
from acwm_core.errors import DataError, suggest

FOLDER = click.Path(path_type=Path)


class Output(click.ParamType[Path]):
    """A path that a command writes to, refused before its work if that cannot be.

    Args:
        folder: it is a folder, not a file.
    """

    name = "path"

    def __init__(self, *, folder: bool = False) -> None:
        self._folder = folder

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path."""
        return writable(Path(value), folder=self._folder)


OUT_FILE, OUT_FOLDER = Output(), Output(folder=True)


class ExistingFolder(click.ParamType[Path]):
    """A folder of some kind that must be there; the nearest one is suggested otherwise.

    Args:
        what: the kind, for the message.
        marker: the file by which a folder is known to be one.
        make: the command that makes one.
    """

    name = "folder"

    def __init__(self, what: str, marker: str, make: str) -> None:
        self._what, self._marker, self._make = what, marker, make

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the folder."""
        path = Path(value)
        if (path / self._marker).is_file():
            return path
        if path.is_dir():
            raise DataError(f"{path} is no {self._what}: it has no {self._marker}")
        beside = [str(file.parent) for file in path.parent.glob(f"*/{self._marker}")]
        near = suggest(str(path), beside) if beside else f"; make one with `{self._make}`"
        raise DataError(f"there is no {self._what} {path}{near}")


RUN = ExistingFolder("run folder", "recipe.yaml", "acwm fit RECIPE")


class Dataset(ExistingFolder):
    """A data folder, or the URL of one: then its folder in the cache."""

    name = "folder or URL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the local folder."""
        if ":" in str(value):
            from acwm_core.data.remote import data_folder

            value = data_folder(value)
        return super().convert(value, param, ctx)


DATASET = Dataset("dataset", "card.yaml", "acwm generate ENVIRONMENT")
