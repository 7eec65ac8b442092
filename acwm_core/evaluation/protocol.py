"""Protocols: which clips are predicted, and tables published with them. Imports no torch."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from acwm_core.errors import AcwmWarning, RecipeError, sentence, suggest
from acwm_core.plugins import catalog

FULL = "full"


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
class PublishedComparison:
    """The published row that a run is compared with.

    Attributes:
        row: the row.
        same_parts: whether it has the run's model, codec, conditioner and share of the data, and
            not only its environment. Frame size and dataset size may differ in either case.
    """

    row: PublishedRow
    same_parts: bool


class Protocol:
    """Chooses the test clips. This base class is the protocol ``full``: whole episodes.

    Plugins register subclasses with the hook `register_protocols`. They are constructed without
    arguments whenever a recipe is checked, so their modules should import nothing heavy.

    Attributes:
        defaults: values for settings of `EvaluationConfig` that are None.
        cuts_windows: whether it cuts several clips from an episode, `evaluation.cuts` of them.
        from_first_frame: whether every clip starts at its episode's first frame, so that its start
            can be perturbed in the simulator.
    """

    defaults: Mapping[str, Any] = {}
    cuts_windows: bool = False
    from_first_frame: bool = True

    def episodes(self, count: int, wanted: int | None) -> list[int]:
        """Indices of the episodes to use, ascending; here the first ones.

        Args:
            count: number of episodes in the split.
            wanted: at most so many, `evaluation.episodes`; None takes all.
        """
        return list(range(min(count, wanted or count)))

    def windows(self, length: int, frames: int | None, cuts: int | None) -> list[tuple[int, int]]:
        """The clips of an episode: first frame and number of frames of each.

        Args:
            length: number of frames of the episode.
            frames: number of frames of a clip, `evaluation.frames`; None takes whole episodes.
            cuts: number of clips, `evaluation.cuts`, if it `cuts_windows`.
        """
        return [(0, min(length, frames or length))]

    def tables(self) -> Mapping[str, PublishedTable]:
        """Published tables that were measured so, by name, the first to be searched first."""
        return {}


def protocol_named(name: str) -> Protocol:
    """The protocol with this name, or a `RecipeError` that suggests the closest name."""
    if name == FULL:
        return Protocol()
    registry = catalog().registry("protocol")
    if name not in registry:
        known = suggest(name, [FULL, *(component.name for component in registry)])
        raise RecipeError(f"evaluation.protocol: unknown {name!r}{known}")
    return registry[name].create_as(Protocol)


def published_tables() -> dict[str, PublishedTable]:
    """The tables of all registered protocols by name; broken ones are skipped with a warning."""
    tables: dict[str, PublishedTable] = {}
    for component in catalog().registry("protocol"):
        try:
            tables |= component.create_as(Protocol).tables()
        except Exception as error:  # the tables may not be needed, so only warn
            warnings.warn(f"left out: {sentence(error)}", AcwmWarning, stacklevel=2)
    return tables


def published_for(setting: Mapping[str, str | float]) -> PublishedComparison | None:
    """The first row with the same setting, else with the same environment; None if none matches."""
    rows = [row for table in published_tables().values() for row in table.rows]
    near = [row for row in rows if row.setting["env"] == setting["env"]]
    row = next((row for row in near if row.setting == setting), near[0] if near else None)
    return PublishedComparison(row, same_parts=row.setting == setting) if row else None
