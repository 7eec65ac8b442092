"""The tables of docs/findings/policies.md: how well the models that ship rank 24 scripted policies.

python benchmarks/ranking_tables.py --list             # the commands
python benchmarks/ranking_tables.py                    # run what is missing, print the tables
python benchmarks/ranking_tables.py reacher push_cube --seeds 0..4

Every command resumes. Results lie in the runs' folders, where `acwm report` finds them.
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

SCORES = ("pearson", "spearman", "kendall", "mmrv", "optimism")

HEADS = ("Task", "Episodes", "Pearson", "Spearman", "Kendall", "MMRV", "Optimism")


def estimate(found: dict[str, Any], digits: int = 2, sign: str = "") -> str:
    """``0.82 (0.22 to 0.98)``, or a dash if it is undefined."""
    value, low, high = (found[name] for name in ("value", "low", "high"))
    if value is None:
        return "–"
    text = f"{value:{sign}.{digits}f}"
    if low is not None and high is not None:
        text += f" ({low:.{digits}f} to {high:.{digits}f})"
    return text.replace("-", "−")


def agreement(ranking: dict[str, Any], score: str) -> str:
    """The row of a world in the table of a score, ``returns`` or ``success``."""
    found = ranking["agreement"]["model"][score]
    digits = {"mmrv": 1, "optimism": 1} if score == "returns" else {}
    cells = [
        estimate(found[name], digits.get(name, 2), "+" if name == "optimism" else "")
        for name in SCORES
    ]
    return row(ranking, str(ranking["episodes"]), *cells)


def decision(ranking: dict[str, Any]) -> str:
    """The row of a world in the table of decision regret."""
    found = ranking["decisions"]["model"]
    return row(ranking, estimate(found["regret"], 3), estimate(found["chance"], 3))


def row(ranking: dict[str, Any], *cells: str) -> str:
    """A row of Markdown that begins with the task."""
    return f"| `{ranking['environment']}.{ranking['task']}` | {' | '.join(cells)} |"


def print_table(heads: tuple[str, ...], rows: list[str]) -> None:
    """Print a table in Markdown."""
    print(f"\n| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    print(*rows, sep="\n")


def main() -> None:
    """Run what is missing and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("worlds", nargs="*", help="all by default")
    parser.add_argument("--seeds", default="0..7")
    parser.add_argument("--list", action="store_true", help="print the commands alone")
    parser.add_argument("--show", action="store_true", help="print the tables of what is there")
    chosen = parser.parse_args()
    if unknown := {*chosen.worlds} - {*TASKS}:
        parser.error(f"no model of {', '.join(sorted(unknown))} ships")
    worlds = chosen.worlds or [*TASKS]
    for world in worlds if not chosen.show else ():
        words = ["acwm", "rank", world, TASKS[world], "--seeds", chosen.seeds]
        print(shlex.join(words), flush=True)
        if not chosen.list:
            subprocess.run(words, check=True)
    if chosen.list:
        return
    places = [Path("runs/trained", w, "ranking", TASKS[w], "ranking.json") for w in worlds]
    found = [json.loads(p.read_text(encoding="utf-8")) for p in places if p.is_file()]
    for score in ("returns", "success"):
        print_table(HEADS, [agreement(each, score) for each in found])
    heads = ("Task", "Decision regret", "At random")
    print_table(heads, [decision(each) for each in found])


if __name__ == "__main__":
    main()
