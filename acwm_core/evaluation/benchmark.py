"""What benchmarks bring as plugins: protocols, and published tables. Free of torch."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acwm_core.catalog import catalog
from acwm_core.errors import AcwmError, AcwmWarning, RecipeError, suggest

if TYPE_CHECKING:
    from acwm_core.evaluation.config import EvaluationConfig
    from acwm_core.evaluation.results import Summary

FULL = "full"


class Protocol:
    """Every test episode from its first frame to its end: the protocol ``full``.

    Plugins register subclasses by the hook `register_protocols`. They are constructed without
    arguments whenever a recipe is checked, so their modules import nothing heavy.

    Attributes:
        defaults: settings of `EvaluationConfig` that are None where nothing else is said.
        cuts_windows: whether it takes several clips of an episode, `evaluation.cuts` of them.
        from_first_frame: whether every clip begins with its episode, so that its start may be
            perturbed in the simulator.
    """

    defaults: Mapping[str, Any] = {}
    cuts_windows: bool = False
    from_first_frame: bool = True

    def episodes(self, count: int, config: EvaluationConfig) -> list[int]:
        """Which of the `count` episodes of a split are taken, in rising order; the first ones."""
        return list(range(min(count, config.episodes or count)))

    def windows(self, length: int, config: EvaluationConfig) -> list[tuple[int, int]]:
        """First frame and number of frames of the clips of an episode of `length` frames."""
        return [(0, min(length, config.frames or length))]


def protocol_named(name: str) -> Protocol:
    """The protocol of that name; a `RecipeError` with the nearest if there is none."""
    if name == FULL:
        return Protocol()
    registry = catalog().registry("protocol")
    if name not in registry:
        known = suggest(name, [FULL, *(component.name for component in registry)])
        raise RecipeError(f"evaluation.protocol: unknown {name!r}{known}")
    return registry[name].create_as(Protocol)


@dataclass(frozen=True)
class PublishedRow:
    """What is reported of one model on one environment.

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
        training_steps: as the table says; None if it does not.
        note: what a reader should know of the table's figures; may be empty.
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
    """A table; what the targets of the hook `register_tables` make.

    Attributes:
        rows: in the order in which a run looks for its own.
        protocol: registered name of the protocol by which they were measured.
        rank: tables of lower rank are searched first.
    """

    rows: Sequence[PublishedRow]
    protocol: str = ""
    rank: int = 100


@dataclass(frozen=True)
class Published:
    """The published row that a run stands beside.

    Attributes:
        row: the row.
        same_parts: whether it has the run's model, codec, conditioner and share of the data, or
            only its environment. The sizes of frames and data may differ in either case.
    """

    row: PublishedRow
    same_parts: bool


def published_tables() -> dict[str, PublishedTable]:
    """All registered tables by name, by their rank; a warning names those that are broken."""
    found: dict[str, PublishedTable] = {}
    for each in catalog().registry("table"):
        try:
            found[each.name] = each.create_as(PublishedTable)
        except AcwmError as error:  # of a table that perhaps nobody asked for
            warnings.warn(f"left out: {error}", AcwmWarning, stacklevel=2)
    return dict(sorted(found.items(), key=lambda item: item[1].rank))


def published_for(setting: Mapping[str, str | float]) -> Published | None:
    """The first row of the same setting, or else of the same environment; None if there is none."""
    rows = [row for table in published_tables().values() for row in table.rows]
    near = [row for row in rows if row.setting["env"] == setting["env"]]
    found = next((row for row in near if row.setting == setting), near[0] if near else None)
    return Published(found, same_parts=found.setting == setting) if found else None


def about_published(summary: Summary) -> str:
    """Where the published figures of a run, if any, are from, and how far they compare."""
    if not summary.published:
        return ""
    row, same = summary.published.row, summary.published.same_parts
    setting = ", ".join(str(row.setting[name]) for name in ("model", "codec", "conditioner"))
    facts = [f"published: {row.citation}, {row.label} ({setting})"]
    if not same:
        facts.append("this run has other components")
    table = published_tables().get(row.table)  # none where its plugin is not installed
    if table and table.protocol and summary.protocol != table.protocol:
        facts.append(f"other clips than its own: see --protocol {table.protocol}")
    return "; ".join(facts) + (f". {row.note}" if row.note else "")
