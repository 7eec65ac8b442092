"""How useful models are: how well they rank policies and plan, compared between runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from acwm_core.evaluation.results import Estimate, Summary
from acwm_report.plans import PlanTable, distance_scale, plan_tables_of
from acwm_report.rankings import Ranking, rankings_of
from acwm_report.table import MISSING, PERCENT, PLAIN, Cell, Column, Row, Scale, Table


@dataclass(frozen=True)
class Use:
    """One number that says how useful a model is in a task.

    Attributes:
        run: label of the run.
        kind: ``"ranking"`` (of policies) or ``"planning"``.
        task: name of the task.
        measure: e.g. ``"spearman"``; see `MEASURES`.
        estimate: the number with its 95 % interval.
        unit: unit of the number.
        episodes: number of episodes behind it.
    """

    run: str
    kind: str
    task: str
    measure: str
    estimate: Estimate
    unit: str
    episodes: int


@dataclass(frozen=True)
class _Measure:
    title: str
    better: str  # arrow that shows which direction is better
    scale: Callable[[str], Scale]  # from the unit to the scale


MEASURES: Mapping[str, _Measure] = {
    "spearman": _Measure("Spearman", "↑", lambda unit: PLAIN),
    "mmrv": _Measure("MMRV", "↓", lambda unit: PLAIN),
    "optimism": _Measure("Optimism", "", lambda unit: PLAIN),
    "regret": _Measure("Regret", "↓", lambda unit: Scale(1.0, 2, unit)),
    "success": _Measure("Solved", "↑", lambda unit: PERCENT),
    "final_distance": _Measure("Final distance", "↓", distance_scale),
}
"""Measures of rankings (by return) and of plans with the model, in table order."""

CAPTION = (
    "Rankings compare returns in the model with true returns. Plans are those made with the model; "
    "intervals of shares are exact (Clopper and Pearson)."
)

KINDS = {"ranking": "ranking policies", "planning": "planning"}


def uses_of(label: str, run: Path, summary: Summary) -> list[Use]:
    """The rankings and plans in a run folder that were made with the evaluated weights."""
    weights = summary.predictor
    ranked = [each for found in rankings_of(run, weights) for each in _ranked(label, found)]
    tables = plan_tables_of(run, weights).values()
    return ranked + [each for found in tables for each in _planned(label, found)]


def _ranked(label: str, found: Ranking) -> list[Use]:
    by, choices = found.agreement["model"]["returns"], found.decisions.get("model")
    told = {"spearman": by.spearman, "mmrv": by.mmrv, "optimism": by.optimism}
    units = {"spearman": ""}
    if choices is not None:
        told["regret"] = choices.regret
    return [
        Use(label, "ranking", found.task, name, each, units.get(name, found.unit), found.episodes)
        for name, each in told.items()
    ]


def _planned(label: str, found: PlanTable) -> list[Use]:
    row = found.row("model")
    if row is None:
        return []
    told = {"success": (row.success, ""), "final_distance": (row.distance, found.unit)}
    return [
        Use(label, "planning", found.task, name, each, unit, row.episodes)
        for name, (each, unit) in told.items()
    ]


def use_table(uses: Sequence[Use], runs: Sequence[str], name: str = "uses") -> Table | None:
    """A table with a row per run and columns per task; None if there are no rankings or plans.

    A run without rankings or plans has dashes. The numbers of episodes are shown too, as they may
    differ between runs.

    Args:
        uses: the measures of all runs.
        runs: labels of the runs, in order.
        name: name of the files that the table is exported to.
    """
    order = {measure: place for place, measure in enumerate(MEASURES)}
    told = sorted(uses, key=lambda use: (use.task, use.kind, order[use.measure]))
    columns, cells = list[Column](), {run: list[Cell]() for run in runs}
    for (task, kind), group in groupby(told, key=lambda use: (use.task, use.kind)):
        heading, own = f"{task.replace('_', ' ')}: {KINDS[kind]}", list(group)
        for measure, each in groupby(own, key=lambda use: use.measure):
            about, by_run = MEASURES[measure], {use.run: use for use in each}
            scale = about.scale(next(iter(by_run.values())).unit)
            key = f"{task}_{kind}_{measure}"
            columns.append(Column(about.title, scale.unit, about.better, heading, key))
            for run in runs:
                found = by_run[run].estimate if run in by_run else None
                cells[run].append(Cell.of(found, scale, signed=measure == "optimism"))
        columns.append(Column("Episodes", group=heading, key=f"{task}_{kind}_episodes"))
        episodes = {use.run: Cell(f"{use.episodes}", value=use.episodes) for use in own}
        for run in runs:
            cells[run].append(episodes.get(run, Cell(MISSING)))
    if not columns:
        return None
    rows = [Row(run, cells[run]) for run in runs]
    return Table("Usefulness of the models", columns, rows, "Run", CAPTION, name)
