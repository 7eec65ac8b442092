"""Pages of a trained policy: its rounds of improvement."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from acwm_core.evaluation.statistics import Estimate
from acwm_core.files import typed
from acwm_planning.resumable import Line
from acwm_policy.improve import Round
from acwm_report.figures import Chart, Curve
from acwm_report.page import write_page
from acwm_report.plan_page import PAGE_FILE as PAGE_FILE
from acwm_report.table import PERCENT, Cell, Column, Row, Table
from acwm_report.titles import counted

ROUNDS_CAPTION = (
    "Success on the same episodes in every round. Intervals of shares are exact (Clopper and "
    "Pearson), that of the gap is bootstrapped over episodes. Frames are those that were simulated "
    "for training; in round 0 there are none."
)


def write_rounds_page(folder: Path, lines: Sequence[Line]) -> Table:
    """Write the page of `acwm policy improve`: a line for each round, and success against frames.

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
        tables=[table],
        charts=[rounds_chart(rounds)],
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


def rounds_chart(rounds: Sequence[Round]) -> Chart:
    """Success against the frames that were simulated for training."""
    curves = [
        _success("in the dream", "model", rounds, [each.dream for each in rounds]),
        _success("in the simulator", "truth", rounds, [each.simulator for each in rounds]),
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
