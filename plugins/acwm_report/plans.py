"""Tables of the results of `acwm plan` in a run folder; see `plan_videos` for its videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from acwm_core.evaluation.results import Estimate
from acwm_core.evaluation.score_grid import MISSING, Cell, Column, Scale
from acwm_core.untrusted import read_json
from acwm_report.run import EvaluatedRun, result_files
from acwm_report.table import Row, Table

FOLDER, FILE = "planning", "summary.json"
"""The results of a task are in ``RUN/planning/TASK/summary.json``."""

PERCENT = Scale(100.0, 0, "%")

ROWS = {
    "model": ("Planning with the model", "the result; other rows are baselines"),
    "simulator": ("Planning with the simulator", "the same planner and cost: the upper bound"),
    "codec": ("Simulator, seen through the codec", "states are read from its reconstructions"),
    "solution": ("Scripted solution", "it looks at the simulator"),
    "policy": ("Behaviour policy", "it made the data and knows no goal"),
    "random": ("Random actions", "each as long as a block"),
    "still": ("Nothing", "no motion"),
}
"""Title and explanation of each way to act."""


@dataclass(frozen=True)
class PlannedRow:
    """The results of one way to act."""

    row: str  # a key of `ROWS`
    episodes: int
    successes: int
    success: Estimate  # share of solved episodes
    distance: Estimate  # mean distance from the goal at the end
    start_distance: float  # mean distance at the start
    p: float | None = None  # p-value of the difference in successes from the first row
    seconds_per_decision: float | None = None


@dataclass(frozen=True)
class PlanTable:
    """A result table of `acwm plan`; other fields of the file are not read."""

    environment: str
    task: str
    rows: list[PlannedRow]
    unit: str = ""  # unit of the distances
    file_sha256: str | None = None  # SHA-256 of the model's file

    def row(self, name: str) -> PlannedRow | None:
        """The row of that name; None if there is none."""
        return next((each for each in self.rows if each.row == name), None)


def plan_tables_of(run: Path, weights: str) -> dict[Path, PlanTable]:
    """The plan tables made with these weights, by folder, in order of their tasks.

    Raises:
        DataError: a table is damaged.
    """
    files = result_files(run, f"{FOLDER}/*/{FILE}")
    found = {path.parent: read_json(path, PlanTable, "a table of plans") for path in files}
    return {path: each for path, each in found.items() if each.file_sha256 == weights}


def planned(run: EvaluatedRun) -> dict[Path, PlanTable]:
    """The plan tables made with the evaluated weights; see `plan_tables_of`."""
    return plan_tables_of(run.folder, run.summary.provenance["weights_sha256"])


def distance_scale(unit: str) -> Scale:
    """The scale to show distances in: metres as centimetres, shares as percent."""
    return Scale(100.0, 1, "cm" if unit == "m" else "%") if unit in ("m", "") else Scale(1, 2, unit)


def plan_tables(run: EvaluatedRun) -> list[Table]:
    """Per task: success and final distance of each way to act, on the same episodes."""
    tables: list[Table] = []
    for found in planned(run).values():
        scale = distance_scale(found.unit)
        columns = [
            *(Column("Solved"), Column("Share", PERCENT.unit, better="↑")),
            Column("Final distance", scale.unit, better="↓"),
            *(Column("At the start", scale.unit), Column("p"), Column("Seconds per decision")),
        ]
        rows: list[Row] = []
        for each in found.rows:
            title, note = ROWS.get(each.row, (each.row, ""))
            seconds = each.seconds_per_decision
            cells = [
                Cell(f"{each.successes}/{each.episodes}", value=each.successes),
                Cell.of(each.success, PERCENT),
                Cell.of(each.distance, scale),
                Cell.of(Estimate(each.start_distance), scale),
                Cell(MISSING if each.p is None else f"{each.p:.2g}", value=each.p),
                Cell(MISSING if seconds is None else f"{seconds:.2g}", value=seconds),
            ]
            rows.append(Row(title, cells, note, strong=each.row == "model"))
        caption = (
            "Intervals of shares are exact (Clopper and Pearson), those of distances bootstrap "
            "intervals over episodes; p is of McNemar’s exact test against the first row."
        )
        head = f"{found.task} · {max((each.episodes for each in found.rows), default=0)} episodes"
        tables.append(Table(head, columns, rows, "Who acts", caption, f"plans-{found.task}"))
    return tables
