"""Types of arguments and options; they refuse wrong values before heavy imports."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from acwm_core.errors import DataError, suggest
from acwm_core.files import writable

FOLDER = click.Path(path_type=Path)


class Output(click.Path):
    """A file or folder that a command writes; refused before any work if it is not writable."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path."""
        return writable(Path(value), folder=self.dir_okay)


OUT_FILE, OUT_FOLDER = Output(dir_okay=False), Output(file_okay=False)


class ExistingFolder(click.ParamType[Path]):
    """A folder of some kind that must exist; if it does not, the most similar name is suggested.

    Args:
        what: the kind, for the message.
        marker: the file that every folder of this kind contains.
        make: the command that makes one.
    """

    name = "folder"

    def __init__(self, what: str, marker: str, make: str) -> None:
        self._what, self._marker, self._make = what, marker, make

    def names(self) -> list[str]:
        """Names that may be given instead of a folder."""
        return []

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the folder."""
        path = Path(value)
        if (path / self._marker).is_file():
            return path
        if path.is_dir():
            raise DataError(f"{path} is not a {self._what}: it has no {self._marker}")
        beside = [str(file.parent) for file in path.parent.glob(f"*/{self._marker}")]
        beside += self.names()
        near = suggest(str(path), beside) if beside else f"; make one with {self._make}"
        raise DataError(f"there is no {self._what} {path}{near}")


class Run(ExistingFolder):
    """A run folder, or the name or address of a trained model, which is copied to a run folder."""

    def names(self) -> list[str]:
        """The names of trained models."""
        from acwm_core.training.run_folder import trained_models

        return trained_models()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the folder."""
        from acwm_core.training.run_folder import run_to_write

        return super().convert(run_to_write(value), param, ctx)


RUN = Run("run folder", "recipe.yaml", "`acwm fit RECIPE`")


class Dataset(ExistingFolder):
    """A data folder, or the URL of one, which is replaced by its folder in the cache."""

    name = "folder or URL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the local folder."""
        if ":" in str(value):
            from acwm_core.data.remote import data_folder

            value = data_folder(value)
        return super().convert(value, param, ctx)


DATASET = Dataset("dataset", "card.yaml", "`acwm generate ENVIRONMENT`")


def size(text: str | int) -> int | tuple[int, int]:
    """Parse a frame size: ``64``, or ``64x96`` for height and width."""
    match = re.fullmatch(r"(\d+)(?:[x×](\d+))?", str(text))
    if match is None:
        raise click.BadParameter(f"{text}: give a side such as 64, or HEIGHTxWIDTH such as 64x96")
    height, width = match.groups()
    return (int(height), int(width)) if width else int(height)


def numbers(text: str) -> tuple[int, ...]:
    """Parse comma-separated numbers."""
    try:
        return tuple(int(number) for number in text.split(",") if text)
    except ValueError:
        wrong = f"{text}: give a number such as 100, or several such as 0,1,2"
        raise click.BadParameter(wrong) from None


def seed_numbers(text: str) -> tuple[int, ...]:
    """Parse seeds: ``0,1,2``, or ``0..49`` for all from 0 to 49."""
    span = re.fullmatch(r"(\d+)\.\.(\d+)", text)
    return tuple(range(int(span[1]), int(span[2]) + 1)) if span else numbers(text)


def seeds_of(context: click.Context, option: click.Parameter, text: str) -> tuple[int, ...]:
    """Parse the seeds of episodes, of which none may be given twice."""
    seeds = seed_numbers(text)
    if not seeds or len({*seeds}) != len(seeds) or min(seeds) < 0:
        raise click.BadParameter(f"{text}: give numbers of episodes, each once: 0,1,2 or 0..49")
    return seeds


def split_options(
    overrides: Sequence[str], section: str = "executor"
) -> tuple[list[str], dict[str, Any]]:
    """Split overrides into all others, and the options that ``executor.NAME=VALUE`` sets.

    Args:
        section: the section to split off, instead of ``executor``.
    """
    from acwm_core.recipe.compose import merge, parse_override

    own = [override for override in overrides if override.startswith(f"{section}.")]
    options: dict[str, Any] = {}
    for override in own:
        options = merge(options, parse_override(override)[section])
    return [override for override in overrides if override not in own], options


def split_parameters(
    section: str, name: str, overrides: Sequence[str]
) -> tuple[list[str], dict[str, Any]]:
    """Split off the parameters that ``section.…`` overrides set for `name`, and check them.

    Returns:
        The other overrides, and the checked parameters.
    """
    from acwm_core.recipe.check import check_component, check_metric_params

    others, given = split_options(overrides, section)
    if section == "metric":
        return others, check_metric_params(section, name, given)
    checked = check_component(section, {"name": name, **given})
    return others, {parameter: checked[parameter] for parameter in given}
