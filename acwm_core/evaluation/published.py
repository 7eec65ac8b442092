"""The figures of ACWM-Phys (arXiv 2605.08567) and the row of them that a run stands beside."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from acwm_core.recipe.text import parse

FILE = "published.yaml"

THOUSANDTHS = ("mse", "m_mse")
"""Metrics that the paper's tables give in thousandths."""

SPLITS = ("ind_test", "ood_test")

Setting = Mapping[str, str | float]
"""Registered names of ``env``, ``model``, ``codec`` and ``conditioner``, and the ``fraction`` of
the training data."""


@dataclass(frozen=True)
class PublishedRow:
    """What the paper reports of one model on one environment.

    Attributes:
        table: key of the table, e.g. ``"conditioning"``.
        label: the table's label in the paper's source.
        title: what the table is about.
        citation: the paper.
        row: the row's name.
        column: name of the group of columns; empty if there is only one.
        setting: what was trained, see `Setting`.
        scores: by split and metric, in the metric's own unit (not in thousandths).
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
class Published:
    """The published row that a run stands beside.

    Attributes:
        row: the row.
        same_parts: whether it has the run's model, codec, conditioner and share of the data, or
            only its environment. The sizes of frames and data may differ in either case.
    """

    row: PublishedRow
    same_parts: bool


@functools.cache
def published_tables() -> Mapping[str, Sequence[PublishedRow]]:
    """All rows by the key of their table: main, conditioning, scale, codec, data, actions."""
    text = resources.files("acwm_core.evaluation").joinpath(FILE).read_text()
    content = parse(text, FILE)
    return {
        key: [_row(key, table, row, content) for row in table["rows"]]
        for key, table in content["tables"].items()
    }


def published_for(setting: Setting) -> Published | None:
    """The first row of the same setting, or else of the same environment; None if there is none."""
    rows = [row for table in published_tables().values() for row in table]
    for row in rows:
        if row.setting == setting:
            return Published(row, same_parts=True)
    for row in rows:
        if row.setting["env"] == setting["env"]:
            return Published(row, same_parts=False)
    return None


def _row(
    key: str, table: Mapping[str, Any], row: Mapping[str, Any], content: Mapping[str, Any]
) -> PublishedRow:
    usual = content["usual"]
    scores = {
        split: {
            metric: value / 1000 if metric in THOUSANDTHS else value
            for metric, value in zip(table["metrics"], row[split], strict=True)
        }
        for split in SPLITS
    }
    return PublishedRow(
        table=key,
        label=table["label"],
        title=table["title"],
        citation=content["citation"],
        row=row["row"],
        column=row.get("column", ""),
        setting={"env": row["env"], **{name: row.get(name, usual[name]) for name in usual}},
        scores=scores,
        training_steps=table.get("training_steps"),
        note=table.get("note", ""),
    )
