"""Compare overrides by what a small model learns in equal time (docs/findings/small-models.md).

    python benchmarks/learning.py --out runs/learning
    python benchmarks/learning.py --out runs/learning --recipe reacher --only Muon --seeds 3
    python benchmarks/learning.py --out runs/learning --recipe push_cube --only shortcut

Every variant is a recipe and a few overrides; `base` is the small recipe before this study improved
it. Each variant trains in one thread for as many steps as fit into the budget, measured by a short
training first. So all get the same CPU time, and the learning rate decays at the end of each run.
Data, seconds per step and finished runs are kept in ``--out``: after an interruption the same
command continues. Set ``--jobs`` to the number of idle cores, and run nothing else meanwhile.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import click
from learning_variants import VARIANTS, overrides
from rich.console import Console
from rich.table import Table

from acwm_core.evaluation.results import Summary
from acwm_core.training.run import read_metadata
from acwm_core.training.run_folder import RunFolder

RECIPES = ("push_cube", "reacher", "robot_arm", "push_rope", "pour_water", "push_sand")
SIZES = {"push_sand": "64x112"}
"""Frame sizes of the data that are not 64x64."""

EVALUATION = (
    "evaluation.metrics=[psnr, m_mse, position_error, permanence]",
    "evaluation.counterfactual_episodes=16",
    "evaluation.perturbed_episodes=0",
    "evaluation.videos=0",
)
"""Settings of the evaluation of each run, on whole episodes."""

CALIBRATION = (10, 60)
"""Steps of two short trainings; their difference in CPU time gives the cost of a step."""

COLUMNS = ("PSNR", "true − other actions", "response", "M-MSE, 10⁻³", "position, mm", "permanence")
COLUMNS += ("PSNR, OoD", "response, OoD")


@dataclass(frozen=True)
class Study:
    """The folders of the study, and the budget of each training.

    Attributes:
        out: folder of data, runs and measurements.
        budget: CPU-seconds per training.
        episodes: numbers for each split, as for `acwm generate`.
        datasets: parent of existing datasets, named after the recipes; None to generate them.
    """

    out: Path
    budget: float
    episodes: str
    datasets: Path | None = None

    @property
    def runs(self) -> Path:
        """The folder of the runs with this budget."""
        return self.out / "runs" / f"{self.budget:.0f}s"

    def data(self, recipe: str) -> Path:
        """The data folder of an environment."""
        return (self.datasets or self.out / "data") / recipe

    def generate(self, recipe: str) -> None:
        """Simulate the data of an environment, unless it is given or already exists."""
        counts = ["--size", SIZES.get(recipe, "64"), "--episodes", self.episodes]
        if self.datasets is None:
            acwm("generate", recipe, *counts, "--out", str(self.data(recipe)))

    def words(self, recipe: str, variant: str) -> list[str]:
        """The command line arguments of a variant."""
        place = f"data.path={self.data(recipe)}"
        return [f"recipes/{recipe}.yaml", "+small", *overrides(variant), place]

    def steps(self, recipe: str, variant: str) -> int:
        """Steps that fit into the budget, by the CPU time per step without the start-up."""
        variant = same_cost(variant)
        kept = self.out / "steps" / f"{slug(recipe, variant)}.json"
        if not kept.exists():
            self._trained(recipe, variant, 2)  # the first encodes the data
            few, more = (self._trained(recipe, variant, steps) for steps in CALIBRATION)
            seconds = (more - few) / (CALIBRATION[1] - CALIBRATION[0])
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps({"cpu_seconds_per_step": seconds}))
        return round(self.budget / json.loads(kept.read_text())["cpu_seconds_per_step"])

    def _trained(self, recipe: str, variant: str, steps: int) -> float:
        """CPU-seconds of a short training, including the start-up."""
        scratch = self.out / "calibration" / slug(recipe, variant)
        shutil.rmtree(scratch, ignore_errors=True)
        length = [f"trainer.max_steps={steps}", "training.warmup_steps=5"]
        quiet = ["training.validate_every_n_steps=1000", "training.sample_every_n_steps=0"]
        return acwm("fit", *self.words(recipe, variant), *length, *quiet, "--out", str(scratch))

    def run(self, recipe: str, variant: str, seed: int) -> Path:
        """Train and evaluate one seed of a variant, unless this is already done."""
        steps = self.steps(recipe, variant)
        folder = RunFolder(self.runs / f"{slug(recipe, variant)}-{seed}")
        if (folder.path / "evaluation" / "summary.json").exists():
            return folder.path
        done = folder.weights.exists() and read_metadata(folder.weights)["step"] >= steps
        if not done:
            shutil.rmtree(folder.path, ignore_errors=True)
            rest = [f"training.seed={seed}", f"trainer.max_steps={steps}"]
            rest += ["training.sample_every_n_steps=0", "--out", str(folder.path)]
            acwm("fit", *self.words(recipe, variant), *rest)
        acwm("evaluate", str(folder.path), *EVALUATION)
        return folder.path


def same_cost(variant: str) -> str:
    """The first variant whose steps cost the same, as losses and learning rates cost nothing."""
    free = ("objective.prediction", "objective.loss_on", "objective.shift", "objective.weighting")
    costly = {
        name: {word for word in own if not word.startswith((*free, "training.learning_rate"))}
        for name, own in VARIANTS.items()
    }
    return next(name for name, own in costly.items() if own == costly[variant])


def slug(*names: str) -> str:
    """Turn names into a file name."""
    return "_".join(" ".join(names).lower().replace(",", "").split())


def acwm(*words: str) -> float:
    """Run an acwm command in one thread; returns its CPU-seconds.

    Raises:
        CalledProcessError: the command failed.
    """
    command = [sys.executable, "-P", "-m", "acwm_core.cli", *words]
    log = subprocess.DEVNULL
    process = subprocess.Popen(
        command, stdout=log, env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    )
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise subprocess.CalledProcessError(status, command)
    return usage.ru_utime + usage.ru_stime


@dataclass(frozen=True)
class Scores:
    """Scores of one run; NaN if the environment does not have the metric.

    Attributes:
        psnr: PSNR in dB.
        gap: loss of PSNR with another episode's actions, dB.
        response: response to other actions.
        m_mse: M-MSE in 10⁻³.
        position: position error in mm.
        permanence: share of frames.
        ood_psnr: PSNR in dB, out of distribution.
        ood_response: response to other actions, out of distribution.
    """

    psnr: float
    gap: float
    response: float
    m_mse: float
    position: float
    permanence: float
    ood_psnr: float
    ood_response: float


def scores(run: Path) -> Scores:
    """Read the scores from the evaluation of a run."""
    splits = Summary.read(run).splits

    def score(metric: str, split: str = "ind_test") -> float:
        found = splits[split].scores.rows["model"].get(metric)
        return math.nan if found is None or found.value is None else found.value

    def response(split: str) -> float:
        counterfactual = splits[split].counterfactual
        found = counterfactual and counterfactual.rows["model"]["response"].value
        return math.nan if found is None else found

    return Scores(
        score("psnr"),
        splits["ind_test"].scores.paired["shuffled"]["psnr"].difference.value or 0,
        response("ind_test"),
        1e3 * score("m_mse"),
        1e3 * score("position_error"),
        score("permanence"),
        score("psnr", "ood_test"),
        response("ood_test"),
    )


def cell(values: Sequence[float]) -> str:
    """The mean, and with several seeds the standard deviation."""
    spread = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.2f}{spread}"


def report(study: Study, recipe: str, variants: Sequence[str]) -> None:
    """Print a line per variant, over the seeds that are done."""
    table = Table("variant", "steps", "seeds", title=f"{recipe}, {study.budget:.0f} CPU-seconds")
    for name in COLUMNS:
        table.add_column(name, justify="right")
    for variant in variants:
        folders = sorted(study.runs.glob(f"{slug(recipe, variant)}-[0-9]*"))
        done = [scores(path) for path in folders if (path / "evaluation/summary.json").exists()]
        if done:
            columns = zip(*(vars(each).values() for each in done), strict=True)
            steps = study.steps(recipe, variant)
            table.add_row(variant, f"{steps:,}", str(len(done)), *map(cell, columns))
    Console(width=120).print(table)


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True)
@click.option("--recipe", "recipes", multiple=True, default=RECIPES, show_default=True)
@click.option("--only", multiple=True, type=click.Choice(list(VARIANTS)), help="Variants; all.")
@click.option("--budget", default=240.0, show_default=True, help="CPU-seconds of each training.")
@click.option("--episodes", default="1000,64,64", show_default=True, help="Of each split.")
@click.option("--datasets", type=click.Path(path_type=Path), help="Parent of datasets to take.")
@click.option("--seeds", default=1, show_default=True)
@click.option("--jobs", default=1, show_default=True, help="Trainings side by side.")
def main(
    out: Path,
    recipes: tuple[str, ...],
    only: tuple[str, ...],
    budget: float,
    episodes: str,
    datasets: Path | None,
    seeds: int,
    jobs: int,
) -> None:
    """Train what is missing, then print a table for every recipe."""
    study = Study(out.resolve(), budget, episodes, datasets and datasets.resolve())
    variants = only or tuple(VARIANTS)
    for recipe in recipes:  # one at a time, as other processes disturb the measurement
        study.generate(recipe)
        for variant in variants:
            study.steps(recipe, variant)
    with ThreadPoolExecutor(jobs) as pool:
        work = [
            pool.submit(study.run, recipe, variant, seed)
            for seed in range(seeds)
            for recipe in recipes
            for variant in variants
        ]
        for done in work:
            done.result()
    for recipe in recipes:
        report(study, recipe, variants)


if __name__ == "__main__":
    main()
