"""Tables of the results of `acwm plan` in a run folder; see `plan_videos` for its videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from acwm_core.evaluation.results import Estimate
from acwm_core.files import read_json
from acwm_planning.jobs import PLANS, SUMMARY
from acwm_report.run import EvaluatedRun, result_files
from acwm_report.score_grid import MISSING, Cell, Column, Scale
from acwm_report.table import Row, Table

PERCENT = Scale(100.0, 0, "%")

COLUMNS = (Column("Solved"), Column("Share", PERCENT.unit, better="↑"))
"""The first columns of a table of plans; those of distances follow, and `LAST`."""

LAST = (Column("p"), Column("Seconds per decision"))

CAPTION = (
    "Intervals of shares are exact (Clopper and Pearson), those of distances bootstrap intervals "
    "over episodes; p is of McNemar’s exact test against the first row."
)

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
    files = result_files(run, f"{PLANS}/*/{SUMMARY}")
    found = {path.parent: read_json(path, PlanTable, "a table of plans") for path in files}
    return {path: each for path, each in found.items() if each.file_sha256 == weights}


def plan_results(run: EvaluatedRun) -> dict[Path, PlanTable]:
    """The plan tables made with the evaluated weights; see `plan_tables_of`."""
    return plan_tables_of(run.folder, run.summary.provenance["weights_sha256"])


def distance_scale(unit: str) -> Scale:
    """The scale to show distances in: metres as centimetres, shares as percent."""
    return Scale(100.0, 1, "cm" if unit == "m" else "%") if unit in ("m", "") else Scale(1, 2, unit)


def plan_tables(run: EvaluatedRun) -> list[Table]:
    """Per task: success and final distance of each way to act, on the same episodes."""
    tables: list[Table] = []
    for found in plan_results(run).values():
        scale = distance_scale(found.unit)
        columns = [
            *COLUMNS,
            Column("Final distance", scale.unit, better="↓"),
            Column("At the start", scale.unit),
            *LAST,
        ]
        rows = [plan_row(each, scale) for each in found.rows]
        head = f"{found.task} · {max((each.episodes for each in found.rows), default=0)} episodes"
        tables.append(Table(head, columns, rows, "Who acts", CAPTION, f"plans-{found.task}"))
    return tables


def plan_row(found: PlannedRow, scale: Scale) -> Row:
    """A line of a table with `COLUMNS`, final distance, distance at the start and `LAST`."""
    title, note = ROWS.get(found.row, (found.row, ""))
    seconds = found.seconds_per_decision
    cells = [
        Cell(f"{found.successes}/{found.episodes}", value=found.successes),
        Cell.of(found.success, PERCENT),
        Cell.of(found.distance, scale),
        Cell.of(Estimate(found.start_distance), scale),
        Cell(MISSING if found.p is None else f"{found.p:.2g}", value=found.p),
        Cell(MISSING if seconds is None else f"{seconds:.2g}", value=seconds),
    ]
    return Row(title, cells, note, strong=found.row == "model")
