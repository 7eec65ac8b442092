"""The tasks that an experiment solves by planning: one table of all worlds, and their videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

from acwm_core.files import read_json
from acwm_experiment.table import Experiment
from acwm_planning.jobs import SUMMARY, PlanningJob
from acwm_report.plan_videos import PlanVideo, VideoRoom
from acwm_report.plans import CAPTION, COLUMNS, LAST, PlanTable, distance_scale, plan_row
from acwm_report.run import EvaluatedRun
from acwm_report.score_grid import Cell, Column, Scale
from acwm_report.table import Row, Table

HEADS = (*COLUMNS, Column("Final distance", better="↓"), Column("At the start"), *LAST)

DISTANCES = (2, 3)
"""Places of the distances in `HEADS`; each world has its own unit."""


def task_tables(experiment: Experiment | None) -> list[Table]:
    """A table for each of the experiment's tables of tasks: all that act, world by world.

    Tasks of which no episode is played are named below; a table of such tasks alone is left out.

    Raises:
        DataError: a table of `acwm plan` is damaged.
    """
    tables: list[Table] = []
    plans = experiment.plans if experiment else ()
    for title, group in groupby(plans, key=lambda plan: plan.table):
        tasks = [*group]
        made = [plan for plan in tasks if plan.progress()]
        caption = "" if experiment is None or experiment.cells else experiment.caption
        missing = ", ".join(plan.row for plan in tasks if plan not in made)
        words = (caption, CAPTION, missing and f"Not played yet: {missing}.")
        rows = [row for plan in made for row in _rows(plan)]
        if rows:
            text = " ".join(filter(None, words))
            tables.append(Table(title, [*HEADS], rows, "Who acts", text, f"plans-{title}"))
    return tables


def task_videos(
    experiment: Experiment | None, shown: Sequence[EvaluatedRun], room: VideoRoom
) -> list[tuple[str, list[PlanVideo]]]:
    """Videos of the model by task, without those that are `shown` with their runs.

    Raises:
        DataError: a video's file is damaged.
    """
    found: list[tuple[str, list[PlanVideo]]] = []
    parents = [run.folder.resolve() for run in shown]
    for number, plan in enumerate(experiment.plans if experiment else ()):
        inside = any(plan.folder.resolve().is_relative_to(parent) for parent in parents)
        if not inside and plan.progress():
            videos = room.take(plan.folder, plan.folder, plan.task, f"task{number}")
            found.append((plan.title, videos))
    return [(title, videos) for title, videos in found if videos]


def _rows(plan: PlanningJob) -> list[Row]:
    found = read_json(plan.folder / SUMMARY, PlanTable, "a table of plans")
    scale = distance_scale(found.unit)
    asked = [plan_row(each, scale) for each in found.rows if each.row in plan.rows]
    return [
        replace(
            row,
            group=f"{plan.row} · {plan.task}",
            cells=[
                _with_unit(cell, scale) if place in DISTANCES else cell
                for place, cell in enumerate(row.cells)
            ],
        )
        for row in asked
    ]


def _with_unit(cell: Cell, scale: Scale) -> Cell:
    return replace(cell, text=f"{cell.text} {scale.unit}")
