"""Evaluated runs as a report reads them, and the words for their parts."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from jinja2 import TemplateError

from acwm_core.errors import AcwmError, AcwmWarning, DataError
from acwm_core.evaluation.results import Estimate, MetricInfo, Score, SetSummary, Summary
from acwm_core.evaluation.storage import read_scores
from acwm_experiment.table import SUMMARY, Experiment
from acwm_report.score_grid import Scale, described

Made = TypeVar("Made")

ROWS = {
    "truth": ("True video", "the noise floor: the error of the estimator of states"),
    "codec": ("Codec reconstruction", "the ceiling: the truth, encoded and decoded"),
    "perturbed": ("Simulator, perturbed", "started a millimetre off; few clips"),
    "model": ("Model, true actions", "what is being evaluated"),
    "shuffled": ("Model, other actions", "same model and noise, another episode’s actions"),
    "copy": ("First frame, copied", "a prediction in which nothing moves"),
}
"""Title and explanation of every row of an evaluation, in table order."""

BESIDE = {
    "model": "Model",
    "truth": "Noise floor",
    "codec": "Codec",
    "perturbed": "Perturbed",
    "shuffled": "Other actions",
    "copy": "First frame",
}
"""Short titles of the rows where they are table columns: the scores first, then their floors."""

OVER = {"copy": "the copied first frame", "shuffled": "other actions"}
"""The baselines that a model is compared with on each clip."""

BRANCHES = {
    "factual": "Its own actions",
    "another": "Another episode’s actions",
    "still": "Nothing is moved",
    "reversed": "Actions reversed in time",
    "mirrored": "Actions mirrored",
}
"""Titles of counterfactual branches; all other branches shift one action dimension."""


def evaluated_runs(folder: str | Path) -> list[Path]:
    """The evaluated runs of the experiment in a folder; there may be none if it has plans.

    Raises:
        DataError: the folder holds no experiment, or one without any result.
    """
    experiment = Experiment.read(folder)
    runs = [run for cell in experiment.cells for run in cell.runs]
    found = dict.fromkeys(run for run in runs if (run / SUMMARY).is_file())
    if not found and not any(plan.progress() for plan in experiment.plans):
        raise DataError(f"no run of {folder} is evaluated yet")
    return [*found]


@dataclass(frozen=True)
class EvaluatedRun:
    """An evaluated run, read from its folder."""

    folder: Path  # the run folder
    summary: Summary  # its scores; every metric has a title
    results: Sequence[Score]  # the results of all rows and clips
    key: str  # prefix that makes its ids unique on a page

    @classmethod
    def read(cls, folder: Path, key: str) -> EvaluatedRun:
        """Read an evaluated run from its folder.

        Raises:
            DataError: there is no such run, or it was not evaluated.
        """
        summary = Summary.read(folder)
        summary = replace(summary, metrics=described(summary.metrics))
        return cls(folder, summary, read_scores(folder), key)

    @property
    def headline(self) -> MetricInfo:
        """Title, unit and direction of the headline metric."""
        return self.summary.metrics[self.summary.headline]

    def scale(self, metric: str) -> Scale:
        """The scale of a metric, shared by all rows and splits."""
        rows = [row for s in self.summary.splits.values() for row in s.scores.rows.values()]
        values = (row[metric].value for row in rows if metric in row)
        return Scale.of(values, self.summary.metrics[metric])

    def headline_scale(self) -> Scale:
        """The scale for the headline metric with one decimal less (at least one), e.g. 0.1 dB."""
        scale = self.scale(self.summary.headline)
        return replace(scale, decimals=max(1, scale.decimals - 1))

    def gains(self, scores: SetSummary) -> dict[str, Estimate]:
        """The model's advantage over each baseline in the headline metric; positive is better."""
        sign = 1 if self.headline.higher_is_better else -1
        found: dict[str, Estimate] = {}
        for each in OVER:
            was = scores.paired[each][self.summary.headline].difference
            ends = (was.value, *(was.low, was.high)[::sign])
            found[each] = Estimate(*(None if end is None else sign * end for end in ends))
        return found

    def metrics(self, reads: str) -> list[str]:
        """Names of the metrics that read ``"pixels"``, or those that read ``"states"``."""
        return [name for name, info in self.summary.metrics.items() if info.reads == reads]


DAMAGE = (
    *(AcwmError, OSError, TemplateError),
    *(LookupError, TypeError, ValueError, ArithmeticError, AttributeError),
)
"""Exceptions from reading and drawing results that are damaged or contradict themselves."""


def of_readable(
    folders: Sequence[Path], make: Callable[[Sequence[Path], Mapping[Path, str]], Made]
) -> Made:
    """Call `make` with the run folders that it can read.

    `make` also gets the reason for each folder that is left out. The user sees an `AcwmWarning`.

    Raises:
        DataError: it can read none of the folders.
    """
    try:
        return make(folders, {})
    except DAMAGE as error:
        broken: dict[Path, str] = {}
        for folder in folders:
            try:
                make([folder], {})
            except DAMAGE as found:
                known = isinstance(found, AcwmError)
                why = f"the results in {folder} are damaged ({type(found).__name__}: {found})"
                broken[folder] = str(found) if known else f"{why}: evaluate the run again"
        kept = [folder for folder in folders if folder not in broken]
        if not broken:  # the error does not come from a single run
            raise
        if not kept:
            raise DataError("; ".join(dict.fromkeys(broken.values()))) from error
        for folder, why in broken.items():
            warnings.warn(f"left out {folder}: {why}", AcwmWarning, stacklevel=2)
        return make(kept, broken)


def result_files(run: Path, pattern: str) -> list[Path]:
    """The files of a run folder that match `pattern`, sorted.

    Raises:
        DataError: a file is a link that leads out of the run folder.
    """
    files = sorted(run.glob(pattern))
    for file in files:
        if not file.resolve().is_relative_to(run.resolve()):
            raise DataError(f"{file} is a link that leads out of {run}")
    return files


def read_runs(folders: Sequence[str | Path]) -> list[EvaluatedRun]:
    """Read evaluated runs.

    Raises:
        DataError: no run is given, or one was not evaluated.
    """
    if not folders:
        raise DataError("a report needs at least one run: name its folder")
    return [EvaluatedRun.read(Path(run), f"run{n}") for n, run in enumerate(folders, start=1)]


def label_title(label: str | None) -> str:
    """A label in words: ``cube count 5 + friction`` for ``cube_count=5+friction``."""
    return (label or "").replace("_", " ").replace("=", " ").replace("+", " + ")


def branch_title(name: str) -> str:
    """The title of a counterfactual branch."""
    return BRANCHES.get(name, f"{name.replace('_', ' ')} shifted")


def clips_title(scores: SetSummary) -> str:
    """The number of clips in words: ``12 episodes``, or ``120 clips of 12 episodes``."""
    if scores.episodes in (0, scores.clips):
        return f"{scores.clips} episodes"
    return f"{scores.clips} clips of {scores.episodes} episodes"


def verdict_title(run: EvaluatedRun) -> str:
    """One line on whether the model beats both baselines, by the intervals of the first split."""
    scores = next(iter(run.summary.splits.values())).scores
    gains = run.gains(scores)
    if all(gain.low is None for gain in gains.values()):
        return "Too few episodes for a verdict"
    predicts, conditioned = ((gains[each].low or 0) > 0 for each in ("copy", "shuffled"))
    if predicts and conditioned:
        return "Action-conditioned prediction"
    if conditioned:
        return "Action-conditioned, but no better than a still frame"
    if predicts:
        return "Better than a still frame, but action-insensitive"
    return "No better than a still frame, and action-insensitive"
