"""Short names of runs, fit for shells and legends."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from acwm_experiment.table import ExperimentCell

OTHER = re.compile(r"[^\w.+-]+")
"""What a shell or a legend may take for something else."""


def run_names(shared: Sequence[str], cells: Sequence[ExperimentCell]) -> list[str]:
    """The names of the runs of cells, such as ``push_cube+small`` or ``curling-adaln``.

    A name has the values of the cell's own overrides; where several cells would share it though
    they differ, it has their parameters, too.

    Args:
        shared: overrides of all cells, of which names tell only the overlays.
        cells: cells with their own overrides.
    """
    short = [_name(shared, cell, parameters=False) for cell in cells]
    meant: dict[str, set[tuple[str, ...]]] = {}
    for name, cell in zip(short, cells, strict=True):
        meant.setdefault(name, set()).add((cell.recipe, *cell.overrides))
    return [
        name if len(meant[name]) == 1 else _name(shared, cell, parameters=True)
        for name, cell in zip(short, cells, strict=True)
    ]


def _name(shared: Sequence[str], cell: ExperimentCell, *, parameters: bool) -> str:
    every = [*shared, *cell.overrides]
    overlays = "".join(dict.fromkeys(each for each in every if each.startswith("+")))
    own = [each.partition("=")[::2] for each in cell.overrides if not each.startswith("+")]
    if parameters:
        words = [Path(cell.recipe).stem + overlays, *(f"{key}-{value}" for key, value in own)]
    else:
        worlds = [value for key, value in own if key == "env"]
        # Another world than that of the recipe, whose name would mislead, usually has other data.
        words = [(worlds[-1] if worlds else Path(cell.recipe).stem) + overlays]
        kept = [(k, v) for k, v in own if k != "env" and not (worlds and k == "data.path")]
        words += [_word(key, value) for key, value in kept]
    return "-".join(filter(None, (OTHER.sub("_", word).strip("_-") for word in words)))


def _word(key: str, value: str) -> str:
    """The name of a component or of data by itself; other values with their parameter."""
    section, _, parameter = key.rpartition(".")
    if not section:
        return value
    if key == "data.path":
        return Path(value).name
    return f"{parameter}{value}" if value[:1].isdigit() else f"{parameter}-{value}"


def safe(words: str) -> str:
    """A name of words, without what a shell or a legend may take for something else."""
    return OTHER.sub("-", words).strip("-")
