"""Folders named on the command line, looked for before anything heavy is imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from acwm_core.errors import DataError, suggest

FOLDER = click.Path(path_type=Path)


class ExistingFolder(click.ParamType[Path]):
    """A folder that must be there; the nearest one is suggested otherwise.

    Args:
        what: what it holds, for the message.
        make: the command that makes one.
    """

    name = "folder"

    def __init__(self, what: str, make: str) -> None:
        self._what, self._make = what, make

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the folder."""
        path = Path(value)
        if path.is_dir():
            return path
        beside = path.parent.iterdir() if path.parent.is_dir() else ()
        folders = [str(each) for each in beside if each.is_dir() and each.name[0] != "."]
        near = suggest(str(path), folders) if folders else f"; make one with `{self._make}`"
        raise DataError(f"there is no {self._what} {path}{near}")


RUN = ExistingFolder("run folder", "acwm fit RECIPE")
DATASET = ExistingFolder("dataset", "acwm generate ENVIRONMENT")
