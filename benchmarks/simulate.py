"""Speed of the environments on one core: `python benchmarks/simulate.py [ENVIRONMENT ...]`.

Each environment (by default every installed one) runs in its own process, bound to one core.
Figures are processor time, so other load on the machine matters little; each episode is run several
times and the best run counts. Columns:

    frames/s    physics with the behaviour policy, and drawing; including the start of the episode
    s/episode   the same plus writing: lossless encoding into a shard
    physics, drawing, writing: shares of that time
    MB          peak memory of the process, including Python and the simulator
    per sort    frames in the time of a fixed NumPy workload (a sort), to compare machines or times

Below is the cost of the whole benchmark: all episodes in the cards of the environments (without
variants), at the cost measured in distribution for `train` and `ind_test`, and out of distribution
for `ood_test`. The last row is Gymnasium's own MuJoCo Reacher-v5 on the same core, drawn with
OpenGL (in software without a GPU).
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from acwm_core.plugins import catalog

CHILD = Path(__file__).with_name("simulate_one.py")
GYMNASIUM = "gymnasium"
GL = ("egl", "osmesa")

Measured = dict[str, Any]
"""The output of simulate_one.py; or ``failed`` with the reason."""


def run(name: str, size: int | None, gl: str, chosen: argparse.Namespace) -> Measured:
    """Measure one environment in a fresh process."""
    wanted = {
        "environment": name,
        "size": size,
        "episodes": chosen.episodes,
        "repeats": chosen.repeats,
        "core": chosen.core,
    }
    command = [sys.executable, str(CHILD), json.dumps(wanted)]
    settings = {**os.environ, "MUJOCO_GL": gl, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=settings)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return {"failed": lines[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def row(name: str, found: Measured) -> str:
    """One line of the table."""
    if "failed" in found:
        return f"{name:24} not measured: {found['failed']}"
    physics, drawing, writing = found["costs"]
    total, speed = physics + drawing + writing, found["frames"] / (physics + drawing)
    size = "×".join(map(str, found["size"]))
    shares = " ".join(f"{100 * cost / total:6.0f} %" for cost in (physics, drawing, writing))
    return (
        f"{name:24} {size:>9} {speed:9.0f} {total:10.3f} {shares} {found['memory']:7.0f} "
        f"{speed / found['sorts']:9.3f}"
    )


def whole_benchmark(results: dict[str, Measured]) -> str:
    """The hours on one core that all episodes of the measured environments would take."""
    variants = {name for found in results.values() for name in found["variants"]}
    worlds = {name: found for name, found in results.items() if name not in variants}
    hours, episodes = 0.0, 0
    for found in worlds.values():
        counts = found["episodes"]
        shifted = counts.get("ood_test", 0)
        usual = sum(counts.values()) - shifted
        episodes += usual + shifted
        hours += (usual * sum(found["costs"]) + shifted * sum(found["ood_costs"])) / 3600
    count = f"{len(worlds)} world{'s' if len(worlds) > 1 else ''}"
    return (
        f"The whole benchmark: {episodes:,} episodes of {count} would take {hours:.1f} hours of "
        "one core."
    )


def gymnasium(size: int | None, chosen: argparse.Namespace) -> Measured:
    """Measure Gymnasium's Reacher-v5 with the first available OpenGL."""
    for gl in GL:
        found = run(GYMNASIUM, size, gl, chosen)
        if "failed" not in found:
            return {**found, "gl": gl}
    return {"failed": f"no OpenGL for it is present ({' nor '.join(GL)})"}


def first_core() -> int:
    """The first core that this process may use."""
    return min(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description="Speed of the environments on one core.")
    parser.add_argument("environments", nargs="*", help="by default all that are installed")
    parser.add_argument("--size", type=int, help="height of a frame; by default each one's own")
    parser.add_argument("--episodes", type=int, default=3, help="different ones (default 3)")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each (default 3)")
    parser.add_argument(
        "--core", type=int, default=first_core(), help="the number of one to run on"
    )
    return parser.parse_args()


def main() -> None:
    """Print the table; fails if an environment could not be measured."""
    chosen = arguments()
    names = chosen.environments or [part.name for part in catalog().registry("environment")]
    print(f"{chosen.episodes} episodes, processor time, best of {chosen.repeats} runs of each")
    print(
        f"{'environment':24} {'size':>9} {'frames/s':>9} {'s/episode':>10} "
        f"{'physics':>8} {'drawing':>8} {'writing':>8} {'MB':>7} {'per sort':>9}"
    )
    results: dict[str, Measured] = {}
    for name in names:
        results[name] = run(name, chosen.size, "disabled", chosen)
        print(row(name, results[name]), flush=True)
    other = gymnasium(chosen.size, chosen)
    print(row(f"Gymnasium Reacher-v5 {other.get('gl', '')}", other))
    failed = [name for name, found in results.items() if "failed" in found]
    if failed:
        sys.exit(f"not measured: {', '.join(failed)}")
    print(whole_benchmark(results))


if __name__ == "__main__":
    main()
