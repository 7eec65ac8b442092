"""Tables of the results of `acwm plan`; see `plan_videos` for its videos."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from pathlib import Path

from acwm_core.evaluation.results import Estimate
from acwm_experiment.table import Experiment
from acwm_planning.jobs import PlanningJob
from acwm_planning.results import PLAN_SUMMARY, PLANS, PlanTable, RowSummary
from acwm_report.run import EvaluatedRun, result_files
from acwm_report.table import MISSING, PERCENT, Cell, Column, Row, Scale, Table
from acwm_report.titles import counted

CAPTION = (
    "Intervals of shares are exact (Clopper and Pearson), those of distances are bootstrapped over "
    "episodes; p is from McNemar’s exact test against the first row."
)


ROWS = {
    "model": ("Planning with the model", "the result; other rows are baselines"),
    "simulator": ("Planning with the simulator", "same planner and cost: upper bound"),
    "codec": ("Simulator through the codec", "states read from reconstructions"),
    "solution": ("Scripted solution", "uses the simulator’s state"),
    "policy": ("Behaviour policy", "collected the data; knows no goal"),
    "random": ("Random actions", "each as long as a block"),
    "still": ("No motion", ""),
}
"""Title and explanation of each way to act."""


def plan_tables_of(run: Path, weights: str) -> dict[Path, PlanTable]:
    """The plan tables made with these weights, by folder, in order of their tasks."""
    files = result_files(run, f"{PLANS}/*/{PLAN_SUMMARY}")
    found = {path.parent: PlanTable.read(path.parent) for path in files}
    return {path: table for path, table in found.items() if table.file_sha256 == weights}


def plan_results(run: EvaluatedRun) -> dict[Path, PlanTable]:
    """The plan tables made with the evaluated weights; see `plan_tables_of`."""
    return plan_tables_of(run.folder, run.summary.predictor)


def distance_scale(unit: str) -> Scale:
    """The scale to show distances in: metres as centimetres, shares as percent."""
    return Scale(100.0, 1, "cm" if unit == "m" else "%") if unit in ("m", "") else Scale(1, 2, unit)


def plan_tables(run: EvaluatedRun) -> list[Table]:
    """A `plan_table` per task."""
    return [plan_table(found) for found in plan_results(run).values()]


def plan_table(found: PlanTable) -> Table:
    """Success and final distance of each way to act, on the same episodes."""
    scale = distance_scale(found.unit)
    rows = [_row(row, scale) for row in found.rows]
    episodes = max((row.episodes for row in found.rows), default=0)
    head = f"{found.task} · {counted(episodes, 'episode')}"
    name = f"plans-{found.task}"
    return Table(head, _columns(scale.unit), rows, "Controller", CAPTION, name)


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
        words = (caption, CAPTION, missing and f"Not run yet: {missing}.")
        rows = [row for plan in made for row in _task_rows(plan)]
        if rows:
            text = " ".join(filter(None, words))
            tables.append(Table(title, _columns(), rows, "Controller", text, f"plans-{title}"))
    return tables


def _task_rows(plan: PlanningJob) -> list[Row]:
    found = PlanTable.read(plan.folder)
    scale, group = distance_scale(found.unit), f"{plan.row} · {plan.task}"
    rows = [row for row in found.rows if row.row in plan.rows]
    return [replace(_row(row, scale, scale.unit), group=group) for row in rows]


def _columns(unit: str = "") -> list[Column]:
    """The columns of a table of plans; without a `unit` of distances, each cell has its own."""
    solved = Column("Solved"), Column("Share", PERCENT.unit, better="↑")
    distances = Column("Final distance", unit, better="↓"), Column("Initial distance", unit)
    efforts = Column("Seconds per decision"), Column("Rollouts per decision")
    return [*solved, *distances, Column("p"), *efforts]


def _row(found: RowSummary, scale: Scale, unit: str = "") -> Row:
    title, note = ROWS.get(found.row, (found.row, ""))
    distances = (Cell.of(each, scale) for each in (found.distance, Estimate(found.start_distance)))
    seconds, rollouts = found.seconds_per_decision, found.rollouts_per_decision
    cells = [
        Cell(f"{found.successes}/{found.episodes}", value=found.successes),
        Cell.of(found.success, PERCENT),
        *(replace(cell, text=f"{cell.text} {unit}".strip()) for cell in distances),
        Cell(MISSING if found.p is None else f"{found.p:.2g}", value=found.p),
        Cell(MISSING if seconds is None else f"{seconds:.2g}", value=seconds),
        Cell(MISSING if rollouts is None else f"{rollouts:.0f}", value=rollouts),
    ]
    return Row(title, cells, note, strong=found.row == "model")
