"""Published tables: the figures that a run may stand beside. Benchmarks bring them as plugins."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from acwm_core.catalog import catalog
from acwm_core.errors import PluginError

if TYPE_CHECKING:
    from acwm_core.evaluation.results import Summary

SPLITS = ("ind_test", "ood_test")

DROP = "↓"
"""Marks what is worse out of distribution than in it."""

Setting = Mapping[str, str | float]
"""Registered names of ``env``, ``model``, ``codec`` and ``conditioner``, and the ``fraction`` of
the training data."""

Figures = Mapping[str, Mapping[str, float]]
"""Scores by split and metric."""


@dataclass(frozen=True)
class PublishedColumn:
    """A metric as a table prints it.

    Attributes:
        metric: registered name.
        title: heading.
        factor: values are multiplied by it.
        decimals: of the printed number.
        higher_is_better: which way is good.
    """

    metric: str
    title: str
    factor: float = 1.0
    decimals: int = 3
    higher_is_better: bool = False


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
        setting: what was trained, see `Setting`.
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
        columns: in the order of the table's source; rows may lack some.
        rows: in the order in which a run looks for its own.
        protocol: registered name of the protocol by which they were measured.
        rank: tables of lower rank are searched first.
    """

    columns: Sequence[PublishedColumn]
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


@dataclass(frozen=True)
class PrintedRow:
    """A name, and a text per split and column of a table; ``–`` where there is no score."""

    name: str
    texts: Mapping[str, Sequence[str]]


def published_tables() -> dict[str, PublishedTable]:
    """All registered tables by name, those of the lowest rank first.

    Raises:
        PluginError: what is registered makes no `PublishedTable`.
    """
    found: dict[str, PublishedTable] = {}
    for component in catalog().registry("table"):
        made: Any = component.create()
        if not isinstance(made, PublishedTable):
            kind = type(made).__name__
            raise PluginError(
                f"table {component.name!r} makes a {kind}, which is no PublishedTable"
            )
        found[component.name] = made
    return dict(sorted(found.items(), key=lambda item: item[1].rank))


def published_for(setting: Setting) -> Published | None:
    """The first row of the same setting, or else of the same environment; None if there is none."""
    rows = [row for table in published_tables().values() for row in table.rows]
    for row in rows:
        if row.setting == setting:
            return Published(row, same_parts=True)
    for row in rows:
        if row.setting["env"] == setting["env"]:
            return Published(row, same_parts=False)
    return None


def printed_rows(summary: Summary) -> tuple[Sequence[PublishedColumn], list[PrintedRow]]:
    """A run's scores as its published table prints them, and the published ones below.

    Returns:
        The columns of either split, and the rows; none where the run has no published row, or where
        the plugin that brings the table is not installed.
    """
    table = published_tables().get(summary.published.row.table) if summary.published else None
    if not summary.published or not table:
        return (), []
    ours = {
        split: {
            name: estimate.value
            for name, estimate in result.scores.rows["model"].items()
            if estimate.value is not None
        }
        for split, result in summary.splits.items()
    }
    row = summary.published.row
    name = " ".join(["published:", row.row, row.column]).strip()
    rows = {summary.run: ours, name: row.scores}
    return table.columns, [PrintedRow(n, _texts(s, table.columns)) for n, s in rows.items()]


def about_published(summary: Summary) -> str:
    """Where the published figures of a run are from, and how far they compare.

    Empty without published figures.
    """
    if not summary.published:
        return ""
    row, same = summary.published.row, summary.published.same_parts
    setting = ", ".join(str(row.setting[name]) for name in ("model", "codec", "conditioner"))
    facts = [f"published: {row.citation}, {row.label} ({setting})"]
    if not same:
        facts.append("this run has other components")
    table = published_tables().get(row.table)
    if table and table.protocol and summary.protocol != table.protocol:
        facts.append(f"other clips than its own: see --protocol {table.protocol}")
    return "; ".join(facts) + (f". {row.note}" if row.note else "")


def _texts(scores: Figures, columns: Sequence[PublishedColumn]) -> dict[str, list[str]]:
    inside = scores.get(SPLITS[0], {})
    texts: dict[str, list[str]] = {split: [] for split in SPLITS}
    for split, column in itertools.product(SPLITS, columns):
        value, near = scores.get(split, {}).get(column.metric), inside.get(column.metric)
        text = "–" if value is None else f"{value * column.factor:.{column.decimals}f}"
        if value is not None and near is not None:
            text += DROP * ((value < near) if column.higher_is_better else (value > near))
        texts[split].append(text)
    return texts
