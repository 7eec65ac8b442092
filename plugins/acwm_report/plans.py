"""Tables of the results of `acwm plan`; see `plan_videos` for its videos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from acwm_core.evaluation.results import Estimate
from acwm_core.files import read_json
from acwm_experiment.table import Experiment
from acwm_planning.jobs import PLAN_SUMMARY, PLANS, PlanningJob
from acwm_report.run import EvaluatedRun, result_files
from acwm_report.table import MISSING, PERCENT, Cell, Column, Row, Scale, Table

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
    """The plan tables made with these weights, by folder, in order of their tasks."""
    files = result_files(run, f"{PLANS}/*/{PLAN_SUMMARY}")
    found = {path.parent: read_json(path, PlanTable, "a table of plans") for path in files}
    return {path: each for path, each in found.items() if each.file_sha256 == weights}


def plan_results(run: EvaluatedRun) -> dict[Path, PlanTable]:
    """The plan tables made with the evaluated weights; see `plan_tables_of`."""
    return plan_tables_of(run.folder, run.summary.predictor)


def distance_scale(unit: str) -> Scale:
    """The scale to show distances in: metres as centimetres, shares as percent."""
    return Scale(100.0, 1, "cm" if unit == "m" else "%") if unit in ("m", "") else Scale(1, 2, unit)


def plan_tables(run: EvaluatedRun) -> list[Table]:
    """Per task: success and final distance of each way to act, on the same episodes."""
    tables: list[Table] = []
    for found in plan_results(run).values():
        scale = distance_scale(found.unit)
        rows = [_row(each, scale) for each in found.rows]
        head = f"{found.task} · {max((each.episodes for each in found.rows), default=0)} episodes"
        name = f"plans-{found.task}"
        tables.append(Table(head, _columns(scale.unit), rows, "Who acts", CAPTION, name))
    return tables


def task_tables(experiment: Experiment | None) -> list[Table]:
    """A table for each of the experiment's tables of tasks: all that act, world by world.

    Tasks of which no episode is played are named below; a table of such tasks alone is left out.
    """
    tables: list[Table] = []
    plans = experiment.plans if experiment else ()
    for title, group in groupby(plans, key=lambda plan: plan.table):
        tasks = [*group]
        made = [plan for plan in tasks if plan.progress()]
        caption = "" if experiment is None or experiment.cells else experiment.caption
        missing = ", ".join(plan.row for plan in tasks if plan not in made)
        words = (caption, CAPTION, missing and f"Not played yet: {missing}.")
        rows = [row for plan in made for row in _task_rows(plan)]
        if rows:
            text = " ".join(filter(None, words))
            tables.append(Table(title, _columns(), rows, "Who acts", text, f"plans-{title}"))
    return tables


def _task_rows(plan: PlanningJob) -> list[Row]:
    found = read_json(plan.folder / PLAN_SUMMARY, PlanTable, "a table of plans")
    scale, group = distance_scale(found.unit), f"{plan.row} · {plan.task}"
    asked = [each for each in found.rows if each.row in plan.rows]
    return [replace(_row(each, scale, scale.unit), group=group) for each in asked]


def _columns(unit: str = "") -> list[Column]:
    """The columns of a table of plans; without a `unit` of distances, each cell has its own."""
    solved = Column("Solved"), Column("Share", PERCENT.unit, better="↑")
    distances = Column("Final distance", unit, better="↓"), Column("At the start", unit)
    return [*solved, *distances, Column("p"), Column("Seconds per decision")]


def _row(found: PlannedRow, scale: Scale, unit: str = "") -> Row:
    title, note = ROWS.get(found.row, (found.row, ""))
    distances = (Cell.of(each, scale) for each in (found.distance, Estimate(found.start_distance)))
    seconds = found.seconds_per_decision
    cells = [
        Cell(f"{found.successes}/{found.episodes}", value=found.successes),
        Cell.of(found.success, PERCENT),
        *(replace(cell, text=f"{cell.text} {unit}".strip()) for cell in distances),
        Cell(MISSING if found.p is None else f"{found.p:.2g}", value=found.p),
        Cell(MISSING if seconds is None else f"{seconds:.2g}", value=seconds),
    ]
    return Row(title, cells, note, strong=found.row == "model")
