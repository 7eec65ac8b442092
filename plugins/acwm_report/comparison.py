"""`compare_runs`: which runs can be compared, and which differences are larger than chance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.errors import DataError, suggest
from acwm_core.evaluation.results import MetricInfo, Score, Summary, write_json
from acwm_core.evaluation.statistics import holm, paired_bootstrap
from acwm_core.evaluation.storage import read_scores
from acwm_core.files import writable
from acwm_report.same_data import agree, checksums, given_frames, same_recipe, still_scores
from acwm_report.uses import Use, uses_of

Rows = dict[tuple[str, int, int, int], Score]
"""The model's results by what identifies a clip: split, episode, first frame and length."""


@dataclass(frozen=True)
class Difference:
    """Two runs compared in one metric on the clips of one split that both predicted.

    Attributes:
        split: test split.
        metric: registered name.
        first: label of the first run.
        second: label of the second run.
        first_mean: mean score of the first run over episodes.
        second_mean: mean score of the second run.
        difference: mean over episodes of second − first; infinite if one run has predictions that
            are not finite, NaN if both have.
        low: lower end of its 95 % confidence interval; None with too few episodes, or too few in
            which the runs differ at all.
        high: upper end.
        p: p-value of a single test; None with too few episodes or an infinite difference.
        p_corrected: the p-value after Holm's correction for all tests of the comparison.
        second_better: number of episodes in which the second run is strictly better.
        first_better: number of episodes in which the first run is strictly better.
        episodes: number of episodes.
        winner: label of the run that is better by more than chance; None if neither is.
    """

    __pydantic_config__ = {"ser_json_inf_nan": "strings"}  # noqa: RUF012

    split: str
    metric: str
    first: str
    second: str
    first_mean: float
    second_mean: float
    difference: float
    low: float | None
    high: float | None
    p: float | None
    p_corrected: float | None
    second_better: int
    first_better: int
    episodes: int
    winner: str | None


@dataclass(frozen=True)
class Comparison:
    """The result of ``acwm compare``, written as JSON."""

    runs: dict[str, str]  # folder of every run, by label
    # SHA-256 of ``recipe`` and ``weights``, or ``predictions`` and ``tasks`` of what was handed in,
    # and of the test data of each split, by label of the run
    hashes: dict[str, dict[str, str]]
    environment: str  # registered name
    protocol: str  # protocol of the evaluations
    units: dict[str, str]  # unit of each metric
    higher_is_better: dict[str, bool]  # for each metric
    differences: list[Difference]  # every pair of runs in every split and metric
    tests: int  # number of p-values that Holm's correction takes into account
    warnings: list[str]  # what to know before trusting the differences
    # how well the models rank policies and plan, where this was tried
    uses: list[Use] = field(default_factory=list[Use])

    def write(self, path: Path) -> None:
        """Write the comparison as JSON."""
        writable(path).parent.mkdir(parents=True, exist_ok=True)
        write_json(path, self)


def compare_runs(
    runs: Sequence[str | Path],
    *,
    metrics: Sequence[str] = (),
    splits: Sequence[str] = (),
) -> Comparison:
    """Compare the models of evaluated runs on the clips that all of them predicted.

    Every pair of runs is tested in every split and metric by `paired_bootstrap` over episodes: the
    clips of one episode are averaged first, since they are not independent. Holm's correction is
    applied to all p-values together.

    Args:
        metrics: metrics to compare; by default all that the runs share. Those with one right
            score, which both may miss on either side, are not compared.
        splits: splits to compare; by default all that the runs share.

    Raises:
        DataError: there are fewer than two runs, one was not evaluated, a metric or split is
            unknown, or the runs share no clips (other environments, test data or protocols).
    """
    folders = [Path(run) for run in runs]
    if len({folder.resolve() for folder in folders}) < max(2, len(folders)):
        raise DataError("a comparison needs at least two different runs")
    summaries = dict(zip(run_labels(folders), map(Summary.read, folders), strict=True))
    results = dict(zip(summaries, map(read_scores, folders), strict=True))
    warnings = _comparability(summaries, results)
    first = next(iter(summaries.values()))
    names = _shared("metric", metrics, [_compared(each) for each in summaries.values()])
    chosen = _shared("split", splits, [list(each.splits) for each in summaries.values()])
    rows = {label: _model_rows(each) for label, each in results.items()}
    metrics_of = {name: first.metrics[name] for name in names}
    warnings += _definitions(summaries, names)
    found = [
        difference
        for split in chosen
        for difference in _differences(split, _common_clips(split, rows, warnings), metrics_of)
    ]
    if not found:
        raise DataError("no metric is defined on the clips that the runs share")
    return Comparison(
        runs={label: str(folder) for label, folder in zip(summaries, folders, strict=True)},
        hashes={label: _hashes(each) | checksums(each) for label, each in summaries.items()},
        environment=first.parts["env"],
        protocol=first.protocol,
        units={name: info.unit for name, info in metrics_of.items()},
        higher_is_better={name: info.higher_is_better for name, info in metrics_of.items()},
        differences=_corrected(found),
        tests=sum(each.p is not None for each in found),
        warnings=warnings,
        uses=[
            use
            for folder, (label, summary) in zip(folders, summaries.items(), strict=True)
            for use in uses_of(label, folder, summary)
        ],
    )


def worsened(comparison: Comparison) -> list[str]:
    """Where the second of two runs is significantly worse than the first, a sentence each.

    Raises:
        DataError: nothing could be tested, because there are too few episodes.
    """
    first, second = comparison.runs
    tested = [d for d in comparison.differences if d.winner or d.p_corrected is not None]
    if not tested:
        raise DataError(
            f"too few episodes to tell whether {second} is worse than {first}: evaluate both on "
            "five or more"
        )
    return [
        f"gate: {second} is worse in {d.metric} on {d.split}: {d.second_mean:.4g} after "
        f"{d.first_mean:.4g} {comparison.units[d.metric]}".rstrip()
        for d in tested
        if d.winner == first
    ]


def _compared(summary: Summary) -> list[str]:
    return [name for name, info in summary.metrics.items() if info.right is None]


def _differences(
    split: str, clips: Mapping[str, list[Score]], metrics: Mapping[str, MetricInfo]
) -> Iterator[Difference]:
    """Compare every pair of runs on their common clips; p-values are not corrected yet."""
    for (name, info), pair in itertools.product(metrics.items(), itertools.combinations(clips, 2)):
        of_pair = {label: clips[label] for label in pair}
        yield from _difference(split, name, of_pair, info.higher_is_better)


def _corrected(found: Sequence[Difference]) -> list[Difference]:
    """Correct the p-values; no run wins unless the difference is larger than chance.

    Infinite differences need no test.
    """
    corrected = holm([each.p for each in found])
    certain = [
        math.isinf(each.difference) or (p is not None and p < 0.05)
        for each, p in zip(found, corrected, strict=True)
    ]
    return [
        replace(each, p_corrected=p, winner=each.winner if sure else None)
        for each, p, sure in zip(found, corrected, certain, strict=True)
    ]


def run_labels(folders: Sequence[Path]) -> list[str]:
    """Names of runs, with as much of their paths as is needed to tell them apart."""
    for depth in range(1, max(len(folder.parts) for folder in folders) + 1):
        labels = ["/".join(folder.parts[-depth:]) for folder in folders]
        if len(set(labels)) == len(labels):
            return labels
    return [str(folder) for folder in folders]


def _comparability(
    summaries: Mapping[str, Summary], results: Mapping[str, Sequence[Score]]
) -> list[str]:
    """Warnings about differences besides the models; an error if the clips cannot be paired."""
    (label, first), *others = summaries.items()
    warnings = [f"{name} is {s.unfinished}" for name, s in summaries.items() if s.unfinished]
    for other, summary in others:
        both = f"{label} and {other} were evaluated"
        for what, fact, remedy in _MUST_AGREE:
            if fact(first) != fact(summary):
                raise DataError(f"{both} {what} ({fact(first)}, {fact(summary)}): {remedy}")
        ours, theirs = checksums(first), checksums(summary)
        for split in [split for split in ours if theirs.get(split, ours[split]) != ours[split]]:
            hashes = f"{split} {ours[split][:8]}, {theirs[split][:8]}"
            if not _equal_but_for_rounding(summaries, results, label, other, split):
                raise DataError(
                    f"{both} on different test data ({hashes}): evaluate both with the same --data"
                )
            warnings.append(
                f"the test data of {label} and {other} were simulated on different kinds of "
                "machines "
                f"({hashes}); still pictures of both have the same scores, so they are compared"
            )
    for what, fact in _SHOULD_AGREE:
        facts = {label: fact(summary) for label, summary in summaries.items()}
        facts = {label: each for label, each in facts.items() if each is not None}
        if len(set(map(repr, facts.values()))) > 1:
            warnings.append(f"{what} differ: " + ", ".join(f"{k} {v}" for k, v in facts.items()))
    return warnings


def _equal_but_for_rounding(
    summaries: Mapping[str, Summary],
    results: Mapping[str, Sequence[Score]],
    first: str,
    second: str,
    split: str,
) -> bool:
    metrics = [
        name
        for name, info in summaries[first].metrics.items()
        if info.reads == "pixels" and name in summaries[second].metrics
    ]
    ours, theirs = (still_scores(results[each], split, metrics) for each in (first, second))
    return same_recipe(summaries[first], summaries[second]) and agree(ours, theirs)


def _definitions(summaries: Mapping[str, Summary], names: Sequence[str]) -> list[str]:
    """A warning if metrics had other definitions when some of the runs were evaluated."""
    found = {name: {each.metrics[name].definition for each in summaries.values()} for name in names}
    changed = [name for name, numbers in found.items() if len(numbers) > 1]
    remedy = "evaluate all runs with this version of acwm"
    return [f"definitions of {', '.join(changed)} differ: {remedy}"] if changed else []


def _hashes(summary: Summary) -> dict[str, str]:
    """SHA-256 of what predicted."""
    names = ("predictions", "tasks") if summary.handed_in else ("recipe", "weights")
    return {name: summary.provenance[f"{name}_sha256"] for name in names}


def _estimator(summary: Summary) -> str:
    facts: Mapping[str, str] = summary.provenance.get("estimator") or {}
    return " and ".join(f"{what} {hashed}" for what, hashed in facts.items()) or "none"


def _mode(summary: Summary) -> str | None:
    """How the model continued beyond a clip; None if unknown."""
    return None if summary.handed_in else summary.provenance.get("mode", "windows")


_MUST_AGREE: tuple[tuple[str, Callable[[Summary], str], str], ...] = (
    ("on different environments", lambda s: s.parts["env"], "their clips cannot be compared"),
    ("by different protocols", lambda s: s.protocol, "evaluate both with the same --protocol"),
    (
        "from different numbers of given frames",
        lambda s: str(given_frames(s)),
        "evaluate both with the same evaluation.context_frames",
    ),
)

_SHOULD_AGREE: tuple[tuple[str, Callable[[Summary], Any]], ...] = (
    ("numbers of sampling steps", lambda s: s.provenance.get("sampling_steps")),
    ("ways of rolling forward", _mode),
    ("seeds of the noise", lambda s: s.provenance["evaluation"].get("seed")),
    ("estimators of states", _estimator),
    ("versions of acwm", lambda s: s.provenance["versions"]["acwm"]),
    ("devices", lambda s: s.provenance["device"].split(" ")[0]),
)


def _shared(kind: str, wanted: Sequence[str], offered: Sequence[Sequence[str]]) -> list[str]:
    common = [name for name in offered[0] if all(name in each for each in offered)]
    for name in wanted:
        if name not in common:
            near = suggest(name, common)
            raise DataError(f"no {kind} {name!r} was evaluated in all of the runs{near}")
    if not common:
        raise DataError(f"the runs share no {kind}: evaluate them in the same way")
    return [name for name in common if name in wanted] if wanted else common


def _model_rows(results: Sequence[Score]) -> Rows:
    found = (each for each in results if each.kind == "model")
    return {(each.split, each.episode, each.start, each.frames): each for each in found}


def _common_clips(
    split: str, runs: Mapping[str, Rows], warnings: list[str]
) -> dict[str, list[Score]]:
    each = [{clip for clip in rows if clip[0] == split} for rows in runs.values()]
    common = sorted(set[Any].intersection(*each))
    if not common:
        remedy = "evaluate them with the same protocol, frames and episodes"
        raise DataError(f"the runs predicted no clip of {split} in common: {remedy}")
    if len(common) < max(map(len, each)):
        counts = ", ".join(str(len(clips)) for clips in each)
        are = "clip common to all is" if len(common) == 1 else "clips common to all are"
        only = f"only the {len(common)} {are} compared"
        warnings.append(f"{split}: the runs predicted {counts} clips; {only}")
    return {label: [rows[clip] for clip in common] for label, rows in runs.items()}


def _difference(
    split: str, metric: str, pair: Mapping[str, Sequence[Score]], higher_is_better: bool
) -> list[Difference]:
    """Compare two runs; empty if no clip has the metric for both. `winner` is not yet tested."""
    (first, ours), (second, theirs) = pair.items()
    episodes: dict[int, list[tuple[float, float]]] = {}
    for one, other in zip(ours, theirs, strict=True):
        scores = one.values[metric], other.values[metric]
        if not any(map(math.isnan, scores)):
            episodes.setdefault(one.episode, []).append(scores)
    if not episodes:
        return []
    means = np.array([np.mean(clips, axis=0) for clips in episodes.values()])
    with np.errstate(invalid="ignore"):  # two infinitely bad scores count as equal
        gaps = np.where(means[:, 0] == means[:, 1], 0.0, means[:, 1] - means[:, 0])
        wins, losses = int((gaps > 0).sum()), int((gaps < 0).sum())
        test = paired_bootstrap(gaps)
    found = Difference(
        split=split,
        metric=metric,
        first=first,
        second=second,
        first_mean=float(means[:, 0].mean()),
        second_mean=float(means[:, 1].mean()),
        difference=test.mean,
        low=test.low,
        high=test.high,
        p=test.p,
        p_corrected=None,
        second_better=wins if higher_is_better else losses,
        first_better=losses if higher_is_better else wins,
        episodes=len(gaps),
        winner=None
        if math.isnan(test.mean)
        else second
        if (test.mean > 0) == higher_is_better
        else first,
    )
    return [found]
