"""Published tables that protocols provide. Does not import torch."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from acwm_core.errors import AcwmWarning, sentence
from acwm_core.evaluation.protocol import Protocol
from acwm_core.plugins import catalog


@dataclass(frozen=True)
class PublishedRow:
    """Published scores of one model on one environment.

    Attributes:
        table: name of the table, e.g. ``"conditioning"``.
        label: the table's label in its source.
        title: what the table is about.
        citation: where it is published.
        row: the row's name.
        column: name of the group of columns; empty if there is only one.
        setting: what was trained: the registered names of ``env``, ``model``, ``codec`` and
            ``conditioner``, and the ``fraction`` of the training data.
        scores: by split and metric, in the metric's own unit.
        training_steps: as given in the table; None if it does not say.
        note: what a reader should know about the table's figures; may be empty.
    """

    table: str
    label: str
    title: str
    citation: str
    row: str
    column: str
    setting: dict[str, str | float]
    scores: dict[str, dict[str, float]]
    training_steps: int | None = None
    note: str = ""


@dataclass(frozen=True)
class PublishedTable:
    """A published table.

    Attributes:
        rows: the rows, in the order in which they are searched for one that matches a run.
        protocol: registered name of the protocol with which they were measured.
    """

    rows: Sequence[PublishedRow]
    protocol: str


@dataclass(frozen=True)
class Published:
    """The published row that a run is compared with.

    Attributes:
        row: the row.
        same_parts: whether it has the run's model, codec, conditioner and share of the data, and
            not only its environment. Frame size and dataset size may differ in either case.
    """

    row: PublishedRow
    same_parts: bool


def published_tables() -> dict[str, PublishedTable]:
    """The tables of all registered protocols by name; broken ones are skipped with a warning."""
    found: dict[str, PublishedTable] = {}
    for each in catalog().registry("protocol"):
        try:
            found |= each.create_as(Protocol).tables()
        except Exception as error:  # the tables may not be needed, so only warn
            warnings.warn(f"left out: {sentence(error)}", AcwmWarning, stacklevel=2)
    return found


def published_for(setting: Mapping[str, str | float]) -> Published | None:
    """The first row with the same setting, else with the same environment; None if none matches."""
    rows = [row for table in published_tables().values() for row in table.rows]
    near = [row for row in rows if row.setting["env"] == setting["env"]]
    found = next((row for row in near if row.setting == setting), near[0] if near else None)
    return Published(found, same_parts=found.setting == setting) if found else None
