"""Evaluated runs as a report reads them, and what it calls them in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from acwm_core.catalog import catalog
from acwm_core.errors import AcwmError, DataError
from acwm_core.evaluation.clip_results import ClipResult, read_results
from acwm_core.evaluation.results import Estimate, MetricInfo, Scores, Summary
from acwm_core.report.comparison import by_clip, paired_means
from acwm_core.report.table import Scale
from acwm_core.statistics import paired_bootstrap

ROWS = {
    "truth": ("Truth itself", "the noise floor of whatever reads states from video"),
    "codec": ("Codec reconstruction", "the ceiling: the truth, encoded and decoded"),
    "perturbed": ("Simulator, perturbed", "started a millimetre off; few clips"),
    "model": ("Model, true actions", "what is being evaluated"),
    "shuffled": ("Model, other actions", "same model and noise, another episode’s actions"),
    "copy": ("First frame, copied", "a prediction in which nothing moves"),
}
"""Title and explanation of every row of an evaluation, in the order of tables."""

BESIDE = {
    "model": "Model",
    "truth": "Noise floor",
    "codec": "Codec",
    "perturbed": "Perturbed",
    "shuffled": "Other actions",
    "copy": "First frame",
}
"""Short titles of the rows where they stand beside one another, the scores before their floors."""

SPLITS = {
    "train": "Training episodes",
    "ind_test": "In distribution",
    "ood_test": "Out of distribution",
}

OVER = {"copy": "the copied first frame", "shuffled": "other actions"}
"""The baselines that a model is compared with, clip by clip."""

BRANCHES = {
    "factual": "Its own actions",
    "another": "Another episode’s actions",
    "still": "Nothing is moved",
    "reversed": "Actions reversed in time",
    "mirrored": "Actions mirrored",
}
"""Kinds of counterfactual branches; others shift one dimension of the action."""


@dataclass(frozen=True)
class EvaluatedRun:
    """An evaluated run, read from its folder.

    Attributes:
        folder: its folder.
        summary: its scores; every metric's title is known, and the headline's differences from the
            baselines have the intervals of `acwm compare`.
        results: rows of all its clips.
        key: makes its ids unique on a page.
    """

    folder: Path
    summary: Summary
    results: Sequence[ClipResult]
    key: str

    @classmethod
    def read(cls, folder: Path, key: str) -> EvaluatedRun:
        """Read it.

        Raises:
            DataError: there is no such run, or it was not evaluated.
        """
        summary, results = Summary.read(folder), read_results(folder)
        splits = {
            split: replace(
                each,
                scores=_tested(each.scores, in_split(results, split), summary.headline),
                labels={
                    label: _tested(scores, in_split(results, split, label), summary.headline)
                    for label, scores in each.labels.items()
                },
            )
            for split, each in summary.splits.items()
        }
        summary = replace(summary, splits=splits, metrics=described(summary.metrics))
        return cls(folder, summary, results, key)

    @property
    def headline(self) -> MetricInfo:
        """Of the metric that heads the page."""
        return self.summary.metrics[self.summary.headline]

    def scale_of(self, values: Iterable[float | None]) -> Scale:
        """One scale for some values of the headline metric."""
        return Scale.of(values, self.headline.unit, self.headline.factor)

    def scale(self, metric: str) -> Scale:
        """One scale for all the rows of a metric, in all splits."""
        rows = [row for s in self.summary.splits.values() for row in s.scores.rows.values()]
        info = self.summary.metrics[metric]
        values = (row[metric].value for row in rows if metric in row)
        return Scale.of(values, info.unit, info.factor)

    def headline_scale(self, more: int = 0) -> Scale:
        """That of the headline metric's differences: 0.1 dB, or so many digits `more`."""
        name = self.summary.headline
        splits = self.summary.splits.values()
        scale = self.scale_of(each.scores.rows["model"][name].value for each in splits)
        return replace(scale, decimals=max(1, scale.decimals - 1) + more)

    def gains(self, scores: Scores) -> dict[str, Estimate]:
        """The model's advantage in the headline metric over each baseline: positive is better."""
        sign = 1 if self.headline.higher_is_better else -1
        found: dict[str, Estimate] = {}
        for each in OVER:
            was = scores.paired[each][self.summary.headline].difference
            ends = (was.value, *(was.low, was.high)[::sign])
            found[each] = Estimate(*(None if end is None else sign * end for end in ends))
        return found

    def metrics(self, reads: str) -> list[str]:
        """The metrics that read ``"pixels"`` or ``"states"`` of video."""
        return [name for name, info in self.summary.metrics.items() if info.reads == reads]


def read_runs(folders: Sequence[str | Path]) -> list[EvaluatedRun]:
    """Read evaluated runs.

    Raises:
        DataError: no run, or one that was not evaluated.
    """
    if not folders:
        raise DataError("a report needs at least one run: name its folder")
    return [EvaluatedRun.read(Path(run), f"run{n}") for n, run in enumerate(folders, start=1)]


def described(metrics: Mapping[str, MetricInfo]) -> dict[str, MetricInfo]:
    """Metrics with all that tables ask of them.

    Results of old hold no more than the unit; for the rest the metric that is registered under the
    name is asked, if there is one.
    """
    return {name: info if info.title else _looked_up(name, info) for name, info in metrics.items()}


def _looked_up(name: str, info: MetricInfo) -> MetricInfo:
    words = name.replace("_", " ")
    title = name.upper().replace("_", "-") if len(name) <= 5 else words[0].upper() + words[1:]
    try:
        metric = catalog().component("metric", name).load()
    except (AcwmError, ImportError):
        return replace(info, title=title)
    asked = {each: getattr(metric, each, None) for each in ("title", "group", "reads")}
    known = {each: value for each, value in asked.items() if isinstance(value, str) and value}
    factor, rank = getattr(metric, "factor", info.factor), getattr(metric, "rank", info.rank)
    return replace(info, **{"title": title, **known}, factor=factor, rank=rank)


def in_split(
    results: Sequence[ClipResult], split: str, label: str | None = None
) -> list[ClipResult]:
    """The rows of the clips of a split, or of those of one `ood_label` in it."""
    there = [each for each in results if each.split == split]
    return there if label is None else [each for each in there if each.ood_label == label]


def _tested(scores: Scores, results: Sequence[ClipResult], metric: str) -> Scores:
    """The scores with the model's differences in a metric as `acwm compare` tests differences."""
    model, paired = by_clip(results), dict(scores.paired)
    for reference, pairs in scores.paired.items():
        rows = (by_clip(results, reference), model)
        _, _, gaps = paired_means(rows, sorted(rows[0].keys() & model.keys()), metric)
        if gaps:
            test = paired_bootstrap(gaps)
            difference = Estimate(test.mean, test.low, test.high)
            paired[reference] = {**pairs, metric: replace(pairs[metric], difference=difference)}
    return replace(scores, paired=paired)


def split_title(split: str) -> str:
    """How a split is called."""
    return SPLITS.get(split, split)


def label_title(label: str | None) -> str:
    """``cube count 5 + friction`` for ``cube_count=5+friction``."""
    return (label or "").replace("_", " ").replace("=", " ").replace("+", " + ")


def branch_title(name: str) -> str:
    """How a counterfactual branch is called."""
    return BRANCHES.get(name, f"{name.replace('_', ' ')} shifted")


def clips_title(scores: Scores) -> str:
    """``12 episodes``, or ``120 clips of 12 episodes``."""
    if scores.episodes in (0, scores.clips):
        return f"{scores.clips} episodes"
    return f"{scores.clips} clips of {scores.episodes} episodes"


def verdict_title(run: EvaluatedRun) -> str:
    """One line: is the model better than both baselines, by the intervals of the first split?"""
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
