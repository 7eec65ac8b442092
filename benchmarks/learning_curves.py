"""Plot loss against CPU time of the runs of learning.py (docs/findings/what-learns-most.md).

    python benchmarks/learning_curves.py --out runs/learning --recipe reacher --figure reacher.svg

It shows variants with the same loss, which can share a chart: those of the optimiser, the
conditioner and the batch size.
"""

from __future__ import annotations

import csv
import statistics
from pathlib import Path

import click
import matplotlib.pyplot as plt
from learning import RECIPES, Study, slug
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

SHOWN = {
    "base": "black",
    "AdamW, half the rate": "tab:blue",
    "Muon, four times the rate": "tab:orange",
    "cross-attention": "tab:red",
    "convolutional actions": "tab:green",
    "batches of 8": "tab:purple",
    "batches of 32": "tab:brown",
}
"""Variants in the chart, and their colours."""

SMOOTHED = 7
"""Number of rows of ``metrics.csv`` (one per ten steps) that are averaged."""


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="That of learning.py.")
@click.option("--recipe", type=click.Choice(RECIPES), required=True)
@click.option("--budget", default=240.0, show_default=True, help="That of learning.py.")
@click.option("--figure", type=click.Path(path_type=Path), required=True)
def main(out: Path, recipe: str, budget: float, figure: Path) -> None:
    """Draw the curves of the first seed of every variant that was trained."""
    study = Study(out.resolve(), budget, "")
    plt.rcParams |= {
        "svg.hashsalt": "learning",
        "svg.fonttype": "none",
        "font.family": "sans-serif",
    }
    drawing, chart = plt.subplots(figsize=(7, 3.4), layout="constrained")
    for variant, colour in SHOWN.items():
        file = study.out / "runs" / f"{slug(recipe, variant)}-0" / "metrics.csv"
        if not file.exists():
            continue
        seconds = study.budget / study.steps(recipe, variant)
        steps, losses = curve(file)
        chart.plot([s * seconds for s in steps], losses, color=colour, label=variant, lw=1.2)
    chart.set(xlabel="CPU-seconds", ylabel="training loss", yscale="log")
    chart.yaxis.set_major_formatter(ScalarFormatter())
    chart.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    chart.yaxis.set_minor_locator(NullLocator())
    chart.spines[["top", "right"]].set_visible(False)
    chart.legend(frameon=False)
    drawing.savefig(figure, metadata={"Date": None})


def curve(file: Path) -> tuple[list[int], list[float]]:
    """Read the steps and smoothed losses."""
    with file.open(newline="") as opened:
        rows = [(int(r["step"]), r["train/loss"]) for r in csv.DictReader(opened)]
    found = [(step, float(loss)) for step, loss in rows if loss]
    windows = [found[max(0, i - SMOOTHED + 1) : i + 1] for i in range(len(found))]
    return [step for step, _ in found], [statistics.fmean(v for _, v in w) for w in windows]


if __name__ == "__main__":
    main()
