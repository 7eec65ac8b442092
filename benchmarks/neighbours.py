"""Slowdown of a CPU training by a busy neighbour process, with the threads that `acwm fit` chooses.

    python benchmarks/neighbours.py RUN [--steps 60] [--neighbours 0 1]

Trains the recipe of RUN, whose latents must be encoded, for some steps in a temporary folder: with
the threads that `acwm fit` chooses, and with all threads spinning, as by default in PyTorch. Each
is measured alone, and beside a process that keeps a core busy the whole time. "cost" is the ratio
of steps per second without and with neighbours; the aim is at most 1.8.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table

from acwm_core.recipe import Recipe

BUSY = "while True: pass"
WAYS: dict[str, dict[str, str]] = {
    "as acwm fit chooses": {},
    "all threads, spinning": {
        "OMP_NUM_THREADS": str(len(os.sched_getaffinity(0))),
        "OMP_WAIT_POLICY": "ACTIVE",
    },
}
WARM_UP = 10
"""Number of steps that are not measured."""


@contextlib.contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Run processes that each keep a core busy."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def steps_per_second(run: Path, steps: int, environment: dict[str, str]) -> tuple[float, str]:
    """The rate of a training after its warm-up, and the number of threads in its recipe."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    with tempfile.TemporaryDirectory() as folder:
        out, code = Path(folder, "run"), "from acwm_core.cli import main; main()"
        words = ["fit", str(run / "recipe.yaml"), "--out", str(out), "training.cpu_threads=null"]
        words += [f"trainer.max_steps={WARM_UP + steps}", "trainer.log_every_n_steps=1"]
        words += [f"training.{each}_every_n_steps=1000000" for each in ("validate", "checkpoint")]
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", code, *words, "training.sample_every_n_steps=0"],
            env={**kept, **environment},
        )
        reached: dict[int, float] = {}
        while process.poll() is None:
            time.sleep(0.01)
            with contextlib.suppress(OSError, IndexError, KeyError, ValueError):
                *_, last = csv.DictReader((out / "metrics.csv").open())
                reached.setdefault(int(last["step"]), time.monotonic())
        if process.returncode:
            raise SystemExit(f"acwm fit ended with exit code {process.returncode}")
        first, last = min(step for step in reached if step >= WARM_UP), max(reached)
        threads = Recipe.from_yaml(out / "recipe.yaml").training["cpu_threads"]
    rate = (last - first) / (reached[last] - reached[first])
    return rate, str(threads or environment.get("OMP_NUM_THREADS"))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="What a busy neighbour costs")
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--neighbours", type=int, nargs="+", default=[0, 1])
    arguments = parser.parse_args()
    table = Table("way", "neighbours", "threads", "steps/s", "cost")
    for way, environment in WAYS.items():
        alone = 0.0
        for count in arguments.neighbours:
            with neighbours(count):
                rate, threads = steps_per_second(arguments.run, arguments.steps, environment)
            alone = alone or rate
            table.add_row(way, str(count), threads, f"{rate:.2f}", f"{alone / rate:.2f}×")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
