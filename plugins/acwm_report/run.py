"""Evaluated runs as a report reads them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from jinja2 import TemplateError

from acwm_core.errors import AcwmError, AcwmWarning, DataError
from acwm_core.evaluation.results import Estimate, MetricInfo, Score, SetSummary, Summary
from acwm_core.evaluation.statistics import MIN_EPISODES
from acwm_core.evaluation.storage import read_scores
from acwm_core.files import inside
from acwm_core.plugins import catalog
from acwm_report.entry import entry_of
from acwm_report.table import Scale
from acwm_report.titles import OVER

Made = TypeVar("Made")


@dataclass(frozen=True)
class EvaluatedRun:
    """An evaluated run, read from its folder."""

    folder: Path  # the run folder
    summary: Summary  # its scores; every metric has a title
    results: Sequence[Score]  # the results of all rows and clips
    key: str  # prefix that makes its ids unique on a page

    @classmethod
    def read(cls, folder: Path, key: str) -> EvaluatedRun:
        """Read an evaluated run from its folder."""
        summary = Summary.read(folder)
        if summary.handed_in:
            entry_of(folder, summary)  # refuses a card that a page must not show
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
        """The model's advantage over each baseline in the headline metric; positive is better.

        Predictions that were handed in have none over other actions.
        """
        sign = 1 if self.headline.higher_is_better else -1
        found: dict[str, Estimate] = {}
        for each in (name for name in OVER if name != "shuffled" or name in scores.paired):
            was = scores.paired[each][self.summary.headline].difference
            ends = (was.value, *(was.low, was.high)[::sign])
            found[each] = Estimate(*(None if end is None else sign * end for end in ends))
        return found

    @property
    def verdict(self) -> str:
        """Whether the model beats both baselines, by the intervals of the first split."""
        gains = self.gains(next(iter(self.summary.splits.values())).scores)
        if all(gain.low is None for gain in gains.values()):
            return "Too few episodes for a verdict."
        better = {each: (gain.low or 0) > 0 for each, gain in gains.items()}
        if "shuffled" not in better:
            how = "beats" if better["copy"] else "is no better than"
            return f"The prediction {how} a still picture."
        predicts, conditioned = better["copy"], better["shuffled"]
        if predicts and conditioned:
            return "The prediction follows the actions, and beats a still picture."
        if conditioned:
            return "The prediction follows the actions, but is no better than a still picture."
        if predicts:
            return "The prediction beats a still picture, but is action-insensitive."
        return "The prediction is no better than a still picture, and action-insensitive."

    @property
    def too_few(self) -> str:
        """Which splits have no intervals, and why; empty if all may have."""
        return too_few(self.summary)

    def metrics(self, reads: str) -> list[str]:
        """Names of the metrics that read ``"pixels"``, or those that read ``"states"``."""
        return [name for name, info in self.summary.metrics.items() if info.reads == reads]


def too_few(summary: Summary) -> str:
    """Which splits have no intervals, as they have too few episodes; empty if all have enough."""
    few = [
        f"{split} has {result.scores.episodes}"
        for split, result in summary.splits.items()
        if result.scores.episodes < MIN_EPISODES
    ]
    return f"which takes {MIN_EPISODES} of them: {', '.join(few)}" if few else ""


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
    """The files of a run folder that match `pattern`, sorted; no link may lead out of it."""
    return [inside(run, str(file.relative_to(run))) for file in sorted(run.glob(pattern))]


def read_runs(folders: Sequence[str | Path]) -> list[EvaluatedRun]:
    """Read evaluated runs."""
    if not folders:
        raise DataError("a report needs at least one run: name its folder")
    return [EvaluatedRun.read(Path(run), f"run{n}") for n, run in enumerate(folders, start=1)]


def described(metrics: Mapping[str, MetricInfo]) -> dict[str, MetricInfo]:
    """Metrics with all the facts that tables need.

    Old results hold only the unit; the rest is taken from the metric registered under the name, if
    there is one.
    """
    return {name: info if info.title else _looked_up(name, info) for name, info in metrics.items()}


def _looked_up(name: str, info: MetricInfo) -> MetricInfo:
    try:
        asked = catalog().component("metric", name).load()
    except (AcwmError, ImportError):
        asked = info
    known = {
        each: getattr(asked, each, getattr(info, each))
        for each in ("title", "group", "reads", "factor", "rank")
    }
    words = name.upper().replace("_", "-") if len(name) <= 5 else name.replace("_", " ")
    return replace(info, **{**known, "title": known["title"] or words[0].upper() + words[1:]})
