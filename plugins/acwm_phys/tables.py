"""The tables of the paper, read from ``tables.yaml``."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib import resources
from typing import Any

import yaml

from acwm_core.evaluation.protocol import PublishedRow, PublishedTable

PROTOCOL = "acwm-phys"

SPLITS = ("ind_test", "ood_test")

FACTORS = {"mse": 1000, "m_mse": 1000, "ssim": 1, "psnr": 1}
"""The paper prints MSE and M-MSE in thousandths."""


@functools.cache
def published_tables() -> dict[str, PublishedTable]:
    """The tables by name."""
    text = resources.files("acwm_phys").joinpath("tables.yaml").read_text("utf-8")
    content = yaml.safe_load(text)
    return {
        name: PublishedTable(
            [_row(name, table, row, content) for row in table["rows"]], protocol=PROTOCOL
        )
        for name, table in content["tables"].items()
    }


def _row(
    name: str, table: Mapping[str, Any], row: Mapping[str, Any], content: Mapping[str, Any]
) -> PublishedRow:
    usual = content["usual"]
    scores = {
        split: {
            metric: value / FACTORS[metric]
            for metric, value in zip(table["metrics"], row[split], strict=True)
        }
        for split in SPLITS
    }
    return PublishedRow(
        table=name,
        label=table["label"],
        title=table["title"],
        citation=content["citation"],
        row=row["row"],
        column=row.get("column", ""),
        setting={"env": row["env"], **{key: row.get(key, usual[key]) for key in usual}},
        scores=scores,
        training_steps=table.get("training_steps"),
        note=table.get("note", ""),
    )
