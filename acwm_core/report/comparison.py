"""`compare_runs`: which differences between runs are larger than chance."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from acwm_core.data.atomic import writable, written_whole
from acwm_core.errors import DataError, suggest
from acwm_core.evaluation.clip_results import ClipResult, read_results
from acwm_core.evaluation.results import Summary
from acwm_core.report.likeness import clip_of, hashes_of, refuse_unlike, warnings_of
from acwm_core.statistics import holm, paired_bootstrap

SIGNIFICANT = 0.05


@dataclass(frozen=True)
class Difference:
    """Two runs in one metric on the clips of one split that both predicted.

    Attributes:
        split: test split.
        metric: registered name.
        first: label of a run.
        second: label of the other.
        first_mean: mean of the first run's score over episodes.
        second_mean: of the second's.
        difference: mean over episodes of second − first.
        low: lower end of its 95 % confidence interval; None with too few episodes, or too few in
            which the runs differ at all.
        high: upper end.
        p: of a single test; None with too few episodes.
        p_corrected: after Holm's correction for all tests of the comparison.
        second_better: episodes in which the second run is strictly better.
        first_better: in which the first is.
        episodes: of how many.
        winner: label of the run that is better by more than chance; None if neither is.
    """

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
    """``acwm compare``'s JSON.

    Attributes:
        runs: folder of every run, by its label.
        hashes: SHA-256 of its ``recipe``, ``weights`` and test data, the latter by split.
        environment: registered name.
        protocol: of the evaluations.
        units: of each metric.
        higher_is_better: of each metric.
        differences: every pair of runs in every split and metric.
        tests: how many p-values were corrected for.
        warnings: what the reader must know before believing the differences.
    """

    runs: dict[str, str]
    hashes: dict[str, dict[str, str]]
    environment: str
    protocol: str
    units: dict[str, str]
    higher_is_better: dict[str, bool]
    differences: list[Difference]
    tests: int
    warnings: list[str]

    def write(self, path: Path) -> None:
        """Write it as JSON.

        Raises:
            DataError: it cannot be written there.
        """
        from pydantic import TypeAdapter

        writable(path).parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path) as partial:
            partial.write_bytes(TypeAdapter(Comparison).dump_json(self, indent=1) + b"\n")


def compare_runs(
    runs: Sequence[str | Path],
    *,
    metrics: Sequence[str] = (),
    splits: Sequence[str] = (),
    seed: int = 0,
) -> Comparison:
    """Compare the models of evaluated runs on the clips that all of them predicted.

    Every pair of runs is tested in every split and metric by `paired_bootstrap` over episodes: the
    clips of one episode are averaged first, since they are not independent. All p-values together
    go through Holm's correction.

    Args:
        runs: run folders, two or more.
        metrics: those to compare; all that the runs share by default.
        splits: those to compare; all that the runs share by default.
        seed: of the resamples.

    Raises:
        DataError: fewer than two runs, one that was not evaluated, an unknown metric or split, or
            runs without a common clip: other environments, test data or protocols.
    """
    folders = [Path(run) for run in runs]
    if len({folder.resolve() for folder in folders}) < max(2, len(folders)):
        raise DataError("a comparison needs at least two runs, each named once")
    summaries = [Summary.read(folder) for folder in folders]
    labels = run_labels(folders)
    refuse_unlike(dict(zip(labels, summaries, strict=True)))
    names = _shared("metric", metrics, [list(summary.metrics) for summary in summaries])
    parts = _shared("split", splits, [list(summary.splits) for summary in summaries])
    rows = [_by_clip(read_results(folder)) for folder in folders]
    warnings = warnings_of(dict(zip(labels, summaries, strict=True)))
    clips = {split: _common_clips(split, rows, warnings) for split in parts}
    info = summaries[0].metrics
    better = {name: info[name].higher_is_better for name in names}
    found = [
        _difference((labels[a], labels[b]), (rows[a], rows[b]), clips[split], metric, better, seed)
        for split, metric in itertools.product(parts, names)
        for a, b in itertools.combinations(range(len(labels)), 2)
    ]
    differences = [each for each in found if each]
    if not differences:
        raise DataError("no metric is defined on the clips that the runs share")
    return Comparison(
        runs=dict(zip(labels, map(str, folders), strict=True)),
        hashes={
            label: hashes_of(summary) for label, summary in zip(labels, summaries, strict=True)
        },
        environment=summaries[0].parts["env"],
        protocol=summaries[0].protocol,
        units={name: info[name].unit for name in names},
        higher_is_better=better,
        differences=_corrected(differences, better),
        tests=sum(each.p is not None for each in differences),
        warnings=warnings,
    )


def run_labels(folders: Sequence[Path]) -> list[str]:
    """A short name for every run: its folder's, with as much of the path as tells them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        labels = [str(Path(*each[-depth:])) for each in parts]
        if len(set(labels)) == len(labels):
            return labels
    return [str(folder) for folder in folders]


def _shared(kind: str, wanted: Sequence[str], offered: Sequence[Sequence[str]]) -> list[str]:
    """Those of the names that every run has, in the first run's order."""
    common = [name for name in offered[0] if all(name in each for each in offered)]
    for name in wanted:
        if name not in common:
            near = suggest(name, common)
            raise DataError(f"no {kind} {name!r} was evaluated in all of the runs{near}")
    if not common:
        raise DataError(f"the runs share no {kind}: evaluate them in the same way")
    return [name for name in common if name in wanted] if wanted else common


_Clip = tuple[str, int, int, int]  # split, episode, first frame, frames
_Rows = Mapping[_Clip, ClipResult]


def _by_clip(results: Sequence[ClipResult]) -> dict[_Clip, ClipResult]:
    return {clip_of(each): each for each in results if each.kind == "model"}


def _common_clips(split: str, rows: Sequence[_Rows], warnings: list[str]) -> list[_Clip]:
    """The clips of a split that all runs predicted, with a warning if some have more.

    Raises:
        DataError: there are none.
    """
    each = [{clip for clip in row if clip[0] == split} for row in rows]
    common = sorted(clip for clip in each[0] if all(clip in other for other in each))
    if not common:
        raise DataError(
            f"the runs predicted no clip of {split} in common: evaluate them with the same "
            "protocol, frames and episodes"
        )
    if len(common) < max(map(len, each)):
        counts = ", ".join(str(len(clips)) for clips in each)
        warnings.append(
            f"{split}: the runs predicted {counts} clips; only the {len(common)} that all of them "
            "predicted are compared"
        )
    return common


def _difference(
    labels: tuple[str, str],
    rows: tuple[_Rows, _Rows],
    clips: Sequence[_Clip],
    metric: str,
    better: Mapping[str, bool],
    seed: int,
) -> Difference | None:
    """One pair of runs in one metric; None where it is defined on no clip of both."""
    first, second, gaps = _episode_means(rows, clips, metric)
    if not gaps:
        return None
    test = paired_bootstrap(gaps, seed)
    rising = sum(gap > 0 for gap in gaps)
    falling = sum(gap < 0 for gap in gaps)
    more, less = (rising, falling) if better[metric] else (falling, rising)
    means = math.fsum(first) / len(first), math.fsum(second) / len(second)
    found = (test.mean, test.low, test.high, test.p, None)
    return Difference(clips[0][0], metric, *labels, *means, *found, more, less, len(gaps), None)


def _episode_means(
    rows: tuple[_Rows, _Rows], clips: Sequence[_Clip], metric: str
) -> tuple[list[float], list[float], list[float]]:
    """Both runs' scores and their differences, one number per episode.

    Clips whose score is not finite in one of the runs are left out in both.
    """
    episodes: dict[int, list[tuple[float, float]]] = {}
    for clip in clips:
        pair = (rows[0][clip].values[metric], rows[1][clip].values[metric])
        if all(map(math.isfinite, pair)):
            episodes.setdefault(clip[1], []).append(pair)
    means = [
        (math.fsum(a for a, _ in pairs) / len(pairs), math.fsum(b for _, b in pairs) / len(pairs))
        for pairs in episodes.values()
    ]
    first, second = [a for a, _ in means], [b for _, b in means]
    return first, second, [b - a for a, b in means]


def _corrected(differences: Sequence[Difference], better: Mapping[str, bool]) -> list[Difference]:
    """With Holm's p-values, and the winners that follow from them."""
    p_values = holm([each.p for each in differences])
    return [
        replace(each, p_corrected=p, winner=_winner(each, p, better[each.metric]))
        for each, p in zip(differences, p_values, strict=True)
    ]


def _winner(each: Difference, p: float | None, higher_is_better: bool) -> str | None:
    if p is None or p >= SIGNIFICANT:
        return None
    return each.second if (each.difference > 0) == higher_is_better else each.first
