"""Pages of trained policies: an evaluation, and rounds of improvement."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from acwm_core.errors import DataError
from acwm_core.evaluation.statistics import Estimate
from acwm_core.files import typed
from acwm_planning.policies.saved import SavedPolicy
from acwm_planning.results import RowSummary
from acwm_planning.resumable import Line
from acwm_policy.improve import TABLE as ROUNDS_TABLE
from acwm_policy.improve import Round
from acwm_policy.train import CURVE
from acwm_report.figures import Chart, Curve
from acwm_report.page import write_page
from acwm_report.plan_page import PAGE_FILE as PAGE_FILE
from acwm_report.plan_videos import linked_videos
from acwm_report.plans import distance_scale
from acwm_report.table import MISSING, PERCENT, PLAIN, Cell, Column, Row, Table
from acwm_report.titles import counted

ROWS = {
    "trained": ("Trained policy", "in the simulator"),
    "dream": ("The same in the dream", "the model moves the states"),
    "beside": ("The policy beside it", "in the simulator"),
    "solution": ("Scripted solution", "knows the goal and the simulator’s state"),
    "behaviour": ("Behaviour policy", "collected the data; knows no goal"),
    "random": ("Random actions", ""),
    "still": ("No motion", ""),
}
"""Title and explanation of each row of an evaluation."""

PLACES = {"dream": "in the dream", "simulator": "in the simulator", "recordings": "of recordings"}
"""Phrases for where a policy has learnt."""

CAPTION = (
    "All rows begin at the same starts. Intervals of shares are exact (Clopper and Pearson), those "
    "of distances are bootstrapped over episodes; p is from McNemar’s exact test against the first "
    "row."
)

ROUNDS_CAPTION = (
    "Success on the same episodes in every round. Intervals of shares are exact (Clopper and "
    "Pearson), that of the gap is bootstrapped over episodes. Frames are those that were simulated "
    "for training; in round 0 there are none, unless the policy learns in the simulator."
)


def write_policy_page(
    folder: Path, where: Path, results: Mapping[str, Any], beside: Path | None = None
) -> Table:
    """Write the page of `acwm policy evaluate`: table, gap, learning curves and videos.

    Args:
        folder: the policy's folder.
        where: that of the results.
        results: what `evaluate_policy` returns.
        beside: folder of the policy beside it.

    Returns:
        The table that it shows.
    """
    table, about = policy_table(results), results["training"]
    asked = ("algorithm", "place", "model", "steps", "cpu_seconds", "scenes", "seed")
    words = [f"{name}={about[name]}" for name in asked if name in about]
    learnt = {"trained": folder, **({} if beside is None else {"beside": beside})}
    write_page(
        where / PAGE_FILE,
        "policy.html.j2",
        title=f"A policy at {results['task']} in {results['environment']}",
        lead=" ".join(words),
        figures=_figures(results),
        tables=[table],
        charts=curve_charts(learnt),
        charts_title="Learning",
        videos=linked_videos(where, "trained", results["task"], "apart by"),
    )
    return table


def policy_table(results: Mapping[str, Any]) -> Table:
    """Success and final distance of a policy, and of what it is compared with."""
    learnt = "held_out" in results  # a reward in place of a task
    scale = PLAIN if learnt else distance_scale(results["unit"])
    found = [typed(row, RowSummary) for row in results["rows"]]
    columns = [Column("Solved"), Column("Share", PERCENT.unit, better="↑")]
    columns += [Column("Final distance", scale.unit, better="↓"), Column("p")]
    rows = [
        Row(
            ROWS[row.row][0],
            [
                Cell(f"{row.successes}/{row.episodes}", value=row.successes),
                Cell.of(row.success, PERCENT),
                Cell.of(row.distance, scale),
                Cell(MISSING if row.p is None else f"{row.p:.2g}", value=row.p),
            ],
            ROWS[row.row][1],
            strong=row.row == "trained",
        )
        for row in found
    ]
    head = f"{results['task']} · {counted(max(row.episodes for row in found), 'episode')}"
    return Table(head, columns, rows, "Who acts", CAPTION, f"policy-{results['task']}")


def curve_charts(folders: Mapping[str, Path]) -> list[Chart]:
    """Success and return, or error, while policies learnt; by row, the folders of the policies."""
    colours, charts = {"trained": "model", "beside": "shuffled"}, list[Chart]()
    for column, label in (
        ("success", "success of the last 100 episodes (%)"),
        ("return", "return of the last 100 episodes"),
        ("error", "error on held-out recordings"),
    ):
        curves = list[Curve]()
        for row, folder in folders.items():
            lines = _curve_lines(folder, column)
            place = SavedPolicy.read(folder).card.training.get("place", "dream")
            factor = 100 if column == "success" else 1
            steps, values = ([factor * v if k else v for v in of] for k, of in enumerate(lines))
            title = f"{ROWS[row][0].lower()}, {PLACES[place]}"
            curves += [Curve(title, colours[row], steps, values)] * (len(steps) > 1)
        name = column.capitalize()
        charts += [Chart(name, f"learning-{column}", curves, "steps", label)] * bool(curves)
    return charts


def _curve_lines(folder: Path, column: str) -> tuple[list[float], list[float]]:
    """Steps and values of a column of a policy's curve where it is known."""
    path = folder / CURVE
    lines = [*csv.DictReader(path.read_text("utf-8").splitlines())] if path.exists() else []
    known = [line for line in lines if line.get(column)]
    return [float(line["steps"]) for line in known], [float(line[column]) for line in known]


def gap_text(gap: Mapping[str, float | None]) -> str:
    """A gap in percentage points, with its interval if it has one."""
    ends = Estimate(gap["mean"], gap["low"], gap["high"])
    interval = PERCENT.interval(ends, signed=True)
    return f"{PERCENT.number(ends.value, signed=True)} %" + (f" ({interval})" if interval else "")


def _figures(results: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The main numbers, each with what it is."""
    titles = {"trained": "solved in the simulator", "dream": "solved in the dream"}
    rows = [row for row in results["rows"] if row["row"] in titles]
    figures = [(f"{row['successes']}/{row['episodes']}", titles[row["row"]]) for row in rows]
    if results["gap"] is not None:
        figures.append((gap_text(results["gap"]), "gap: the dream minus the simulator, 95 %"))
    return figures


def rounds_beside(folder: Path, task: str, episodes: int) -> Curve:
    """Success in the rounds of another folder, to show beside those of a task.

    Raises:
        DataError: it is of another task, or of another number of episodes.
    """
    lines = [*csv.DictReader((folder / ROUNDS_TABLE).read_text("utf-8").splitlines())]
    for line in lines:
        if (line["task"], int(line["episodes"])) != (task, episodes):
            raise DataError(
                f"{folder} has rounds of {line['task']} on {line['episodes']} episodes: --beside "
                f"takes those of {task} on the same {episodes}"
            )
    ends = (
        [100 * float(line[f"simulator{end}"]) for line in lines] for end in ("", "_low", "_high")
    )
    frames = [float(line["frames"]) for line in lines]
    return Curve(f"in the simulator: {folder.name}", "shuffled", frames, next(ends), "--", *ends)


def write_rounds_page(folder: Path, lines: Sequence[Line], beside: Curve | None = None) -> Table:
    """Write the page of `acwm policy improve`: a line for each round, and success against frames.

    Args:
        folder: of the rounds.
        lines: of `improve_policy`.
        beside: another curve to draw; see `rounds_beside`.

    Returns:
        The table that it shows.
    """
    rounds = sorted((typed(line, Round) for line in lines), key=lambda each: each.round)
    table = rounds_table(rounds)
    write_page(
        folder / PAGE_FILE,
        "policy.html.j2",
        title=f"Rounds of {rounds[0].task}",
        lead="",
        figures=(),
        tables=[table],
        charts=[rounds_chart(rounds, [] if beside is None else [beside])],
        charts_title="Over the rounds",
        videos=[],
    )
    return table


def rounds_table(rounds: Sequence[Round]) -> Table:
    """Success in the dream and in the simulator, and the gap, of each round."""
    columns = [
        Column("Simulated frames"),
        Column("Steps of the policy"),
        Column("In the dream", "%"),
        Column("In the simulator", "%", better="↑"),
        Column("Gap", "%", better="→ 0"),
    ]
    rows = [
        Row(
            f"Round {each.round}",
            [
                Cell(f"{each.frames:,}", value=each.frames),
                Cell(f"{each.steps:,}", value=each.steps),
                Cell.of(each.dream, PERCENT),
                Cell.of(each.simulator, PERCENT),
                Cell.of(each.gap, PERCENT, signed=True),
            ],
            strong=each is rounds[-1],
        )
        for each in rounds
    ]
    head = f"{rounds[0].task} · {counted(rounds[0].episodes, 'episode')}"
    return Table(head, columns, rows, "Round", ROUNDS_CAPTION, f"rounds-{rounds[0].task}")


def rounds_chart(rounds: Sequence[Round], beside: Sequence[Curve] = ()) -> Chart:
    """Success against the frames that were simulated for training, beside other curves."""
    dreams = [each.dream for each in rounds]
    curves = [
        *[_success("in the dream", "model", rounds, dreams)] * any(dreams),
        _success("in the simulator", "truth", rounds, [each.simulator for each in rounds]),
        *beside,
    ]
    labels = "simulated frames", "success (%)"
    return Chart("Success", f"rounds-{rounds[0].task}", curves, *labels, points=True)


def _success(
    title: str, colour: str, rounds: Sequence[Round], values: Sequence[Estimate | None]
) -> Curve:
    parts: list[list[Any]] = [
        [None if each is None or end is None else 100 * end for each, end in pairs]
        for pairs in (
            [(each, each and getattr(each, name)) for each in values]
            for name in ("value", "low", "high")
        )
    ]
    return Curve(title, colour, [each.frames for each in rounds], parts[0], "-", *parts[1:])
