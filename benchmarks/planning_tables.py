"""The tables of docs/planning.md: planning with the models that ship, on the same 50 episodes.

python benchmarks/planning_tables.py --list                # the commands
python benchmarks/planning_tables.py                       # run what is missing, print the table
python benchmarks/planning_tables.py reacher push_cube --seeds 0..9

Every command can be resumed. Results are in the run folders, where `acwm report` finds them.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
from pathlib import Path
from typing import Any

TASKS = {
    "push_cube": "place",
    "stack_cube": "stack",
    "push_rope": "shape",
    "cloth_move": "edge",
    "push_sand": "gather",
    "pour_water": "fill",
    "robot_arm": "reach",
    "reacher": "reach",
}

ROWS = ("model", "solution", "policy", "random", "still")
"""The rows that act in all episodes."""

SIMULATED = ("reacher", "push_cube", "pour_water")
"""Environments in which the planner also plans with the simulator. This is slow, as every candidate
is simulated from the episode's start."""

FEWER = ("planner.candidates=24", "planner.iterations=3", "planner.elites=5", "cost.frames=2")
"""Settings for planning with the simulator, and with the model compared to it."""


def commands(worlds: list[str], seeds: str, simulated_seeds: str, out: Path) -> list[list[str]]:
    """All commands, the quick ones first.

    Args:
        worlds: names of trained models.
        seeds: seeds of the episodes.
        simulated_seeds: seeds of the episodes planned with the simulator.
        out: parent folder of the results with the simulator.
    """
    rows = [*(word for row in ROWS for word in ("--row", row)), "--videos", "4"]
    made = [["acwm", "plan", world, TASKS[world], "--seeds", seeds, *rows] for world in worlds]
    both = ["--row", "model", "--row", "simulator"]
    for world in worlds:
        if world in SIMULATED:
            where = ["--out", str(out / f"{world}-simulator"), "--videos", "0"]
            words = ["acwm", "plan", world, TASKS[world], *FEWER, "cost=state"]
            made.append([*words, "--seeds", simulated_seeds, *both, *where])
    return made


def table(path: Path) -> list[str]:
    """The Markdown lines of a table of plans."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    lines: list[str] = []
    for row in found["rows"]:
        low, high = (100 * row["success"][end] for end in ("low", "high"))
        p = "" if row["p"] is None else f"{row['p']:.2g}"
        seconds = row["seconds_per_decision"]
        distance = row["distance"]
        known = distance["low"] is not None
        interval = f" ({distance['low']:.3g} to {distance['high']:.3g})" if known else ""
        cells = (
            f"`{found['environment']}.{found['task']}`",
            f"`{row['row']}`",
            f"{row['successes']}/{row['episodes']} ({low:.0f} to {high:.0f} %)",
            p,
            f"{distance['value']:.3g}{interval} of {row['start_distance']:.3g} {found['unit']}",
            "" if seconds is None else f"{seconds:.1f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Run the missing commands and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("worlds", nargs="*", help="all by default")
    parser.add_argument("--seeds", default="0..49")
    parser.add_argument("--simulated-seeds", default="0..49", help="of rows with the simulator")
    parser.add_argument("--out", type=Path, default=Path("runs/planning"))
    parser.add_argument("--list", action="store_true", help="print the commands alone")
    chosen = parser.parse_args()
    if unknown := {*chosen.worlds} - {*TASKS}:
        parser.error(f"no model of {', '.join(sorted(unknown))} ships")
    worlds = chosen.worlds or [*TASKS]
    for words in commands(worlds, chosen.seeds, chosen.simulated_seeds, chosen.out):
        print(shlex.join(words), flush=True)
        if not chosen.list:
            subprocess.run(words, check=True)
    if chosen.list:
        return
    print("| Task | Who acts | Solved | p | Final distance | s / decision |")
    print("| --- | --- | --- | --- | --- | --- |")
    for world in worlds:
        own = Path("runs/trained", world, "planning", TASKS[world], "summary.json")
        for path in (own, chosen.out / f"{world}-simulator" / "summary.json"):
            if path.is_file():
                print(*table(path), sep="\n")


if __name__ == "__main__":
    main()
