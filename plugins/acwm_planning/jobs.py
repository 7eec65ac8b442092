"""A task of an experiment that is solved by planning: what is asked for, and how much is there."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_planning.results import PLAN_SUMMARY


@dataclass(frozen=True)
class PlanningJob:
    """Episodes that `acwm plan` plays, finished or not."""

    table: str  # title of the table that it is part of
    row: str  # its label in the table
    run: Path  # folder with the model's weights
    environment: str  # registered name
    task: str  # name of a task of the environment
    settings: Mapping[str, Any]  # settings of planning, as `Settings.to_dict` returns them
    rows: tuple[str, ...]  # what chooses the actions, of `settings.ROW_NAMES`
    seeds: tuple[int, ...]  # numbers of the episodes, the same for all rows
    folder: Path  # folder of the results

    @property
    def title(self) -> str:
        """Its table and row."""
        return f"{self.table} · {self.row}"

    @property
    def episodes(self) -> int:
        """The number of episodes in all rows."""
        return len(self.rows) * len(self.seeds)

    def progress(self) -> float:
        """The share of its episodes that are in its folder, in [0, 1].

        Episodes of other weights or settings do not count. Rows that the task does not have, such
        as a scripted solution, are not missing, nor are seeds that are solved at their start and
        episodes in which something failed.
        """
        try:
            summary: Mapping[str, Any] = parse_json((self.folder / PLAN_SUMMARY).read_bytes())
            settings = {"environment": self.environment, "task": self.task, **self.settings}
            if any(summary.get(name) != value for name, value in settings.items()):
                return 0.0
            if summary["file_sha256"] != file_sha256(self.run / "model.safetensors"):
                return 0.0
            present = {(row["row"], seed) for row in summary["rows"] for seed in row["seeds"]}
            rows = {*self.rows} - {*summary.get("left_out", ())}
            seeds = {*self.seeds} - {*summary.get("solved_at_start", ())}
            failed = {(row, seed) for row, seed, _ in summary.get("failed", ())}
            required = {*itertools.product(rows, seeds)} - failed
            return 1.0 if required <= present else len(required & present) / len(required)
        except (OSError, ValueError, LookupError, TypeError, AttributeError, DataError):
            return 0.0
