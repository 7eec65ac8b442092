"""The boards of a leaderboard: runs that predicted the same clips, a table per capability."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from acwm_core.evaluation.results import MetricInfo, Summary
from acwm_core.evaluation.views import metric_and_view
from acwm_report.draws import draws_phrase
from acwm_report.run import described
from acwm_report.same_data import agree, checksums, given_frames, mean_still_scores, same_recipe
from acwm_report.scores import (
    ModelScores,
    ScoreGrid,
    compared_metrics,
    model_scores,
    scored_shares,
    shortcomings,
)
from acwm_report.table import Row, Table
from acwm_report.titles import clips_title, split_title
from acwm_report.uses import Use, use_table

PIXELS = "Pixels"
TITLES = {"Physics": "Laws", "Actions": "Response to actions"}
"""Titles of capabilities that differ from the groups of their metrics."""


@dataclass(frozen=True)
class Board:
    """The runs that predicted the same clips."""

    environment: str  # registered name
    protocol: str  # with the settings that decide which clips are predicted
    data: str  # the first characters of the test data's hashes
    clips: str  # how many clips of each split
    tables: dict[str, Table]  # one row per run, the best first, by capability; pixels first
    names: list[str]  # of the runs, the best in pixels first
    uses: Table | None = None  # how well they rank policies and plan; None if none was tried
    keys: dict[str, str] = field(default_factory=dict[str, str])  # ids of their cards, by name

    @property
    def table(self) -> Table:
        """The first table."""
        return next(iter(self.tables.values()))


def boards_of(entries: Mapping[str, Summary], uses: Sequence[Use] = ()) -> list[Board]:
    """Group runs that predicted the same clips (same environment, protocol and data) in tables."""
    groups: dict[tuple[str, ...], list[dict[str, Summary]]] = {}
    for name, summary in entries.items():
        alike = groups.setdefault(_clips_of(summary), [])
        for group in alike:
            if _same_data(next(iter(group.values())), summary):
                group[name] = summary
                break
        else:
            alike.append({name: summary})
    found = [group for place in sorted(groups) for group in groups[place]]
    return [_board(number, group, uses) for number, group in enumerate(found)]


def _clips_of(summary: Summary) -> tuple[str, ...]:
    """What decides which clips are predicted from how much, apart from the data."""
    clips = [
        f"{split} {each.scores.clips} {each.scores.episodes} {_longest(each.horizon)}"
        for split, each in summary.splits.items()
    ]
    damaged = [name for name in summary.left_out if name.startswith("episode ")]
    return summary.parts["env"], _protocol(summary), *clips, *damaged


def _longest(horizon: Mapping[str, Mapping[str, Sequence[float | None]]]) -> int:
    """The number of frames that are scored of the longest clip."""
    return max((len(curve) for row in horizon.values() for curve in row.values()), default=0)


def _same_data(first: Summary, second: Summary) -> bool:
    ours, theirs = checksums(first), checksums(second)
    if all(ours.get(split) == theirs.get(split) for split in first.splits):
        return True
    return same_recipe(first, second) and agree(mean_still_scores(first), mean_still_scores(second))


def _board(number: int, entries: Mapping[str, Summary], uses: Sequence[Use]) -> Board:
    first = next(iter(entries.values()))
    found = [*map(checksums, entries.values())]
    hashes = {s: dict.fromkeys(each[s][:8] for each in found if s in each) for s in first.splits}
    keys = {name: f"entry-{number}-{place}" for place, name in enumerate(entries)}
    scores = {name: model_scores(summary) for name, summary in entries.items()}
    tables = {
        capability: _table(entries, of, metrics, keys, f"board-{number}-{capability.lower()}")
        for capability, metrics, of in _capabilities(list(entries.values()), scores, entries)
    }
    names = sorted(entries, key=lambda name: (_place(entries[name]), name))
    return Board(
        environment=first.parts["env"],
        protocol=_protocol(first),
        data=", ".join(f"{split} {' ≈ '.join(each)}" for split, each in hashes.items()),
        clips=", ".join(
            f"{split_title(s)}: {clips_title(each.scores)}" for s, each in first.splits.items()
        ),
        tables=tables,
        names=names,
        uses=use_table([use for use in uses if use.run in names], names, f"uses-{number}"),
        keys=keys,
    )


def _capabilities(
    summaries: Sequence[Summary],
    scores: Mapping[str, ModelScores],
    entries: Mapping[str, Summary],
) -> Iterable[tuple[str, Mapping[str, MetricInfo], Mapping[str, ModelScores]]]:
    """The title, the metrics and each run's scores of every capability that was measured."""
    first = summaries[0]
    pixels = compared_metrics(summaries) or {first.headline: first.metrics[first.headline]}
    yield PIXELS, pixels, scores
    defined = {
        metric
        for each in scores.values()
        for (_, metric), score in each.items()
        if score.value is not None and not metric_and_view(metric)[1]
    }
    groups: dict[str, dict[str, MetricInfo]] = {}
    for metric, info in (item for each in summaries for item in each.metrics.items()):
        if metric in defined and metric not in pixels:
            groups.setdefault(info.group, {})[metric] = info
    groups.pop(PIXELS, None)  # pixels that are no column of the first table
    for group, metrics in groups.items():
        yield TITLES.get(group, group), metrics, scores
    responses = {name: response_scores(summary) for name, summary in entries.items()}
    measured = dict.fromkeys(metric for each in responses.values() for _, metric in each)
    if measured:
        infos = {name: MetricInfo("", higher_is_better=True) for name in measured}
        yield TITLES["Actions"], described(infos), responses


def response_scores(summary: Summary) -> ModelScores:
    """How well the model's responses to other actions are, by split and metric."""
    found = {s: each.counterfactual for s, each in summary.splits.items() if each.counterfactual}
    return {
        (split, name): score
        for split, each in found.items()
        for name, score in each.rows.get("model", {}).items()
    }


def _table(
    entries: Mapping[str, Summary],
    scores: Mapping[str, ModelScores],
    metrics: Mapping[str, MetricInfo],
    keys: Mapping[str, str],
    name: str,
) -> Table:
    grid = ScoreGrid.of(list(scores.values()), metrics)
    headline = next(iter(entries.values())).headline
    leading = headline if headline in metrics else min(metrics, key=lambda m: metrics[m].rank)
    place = next((place for place in grid.places if place[1] == leading), grid.places[0])
    sign = -1 if metrics[place[1]].higher_is_better else 1

    def order(entry: str) -> tuple[float, str]:
        score = scores[entry].get(place)
        value = None if score is None else score.value
        return float("inf") if value is None else sign * value, entry

    rows = [
        Row(
            title_of(entry, entries[entry]),
            grid.cells(scores[entry]),
            ", ".join(_remarks(entry, entries[entry], metrics)),
            link=keys[entry],
        )
        for entry in sorted(entries, key=order)
    ]
    return Table("", grid.columns(), rows, "Entry", name=name)


def title_of(name: str, summary: Summary) -> str:
    """What an entry is called: the name on its card, or where the run lies."""
    return summary.parts["model"] if summary.handed_in else name


def _remarks(name: str, summary: Summary, metrics: Iterable[str]) -> list[str]:
    where = [name] if summary.handed_in and name != summary.parts["model"] else []
    drawn = {split: draws_phrase(summary, split) for split in summary.splits}
    found = [f"{split_title(split)}: {phrase}" for split, phrase in drawn.items() if phrase]
    return [*where, *shortcomings(summary), *_scored(summary, [*metrics]), *found]


def _scored(summary: Summary, metrics: Sequence[str]) -> list[str]:
    """A phrase with the share that is scored of the model; of several metrics their range."""
    rows = [each.scores.shares.get("model", {}) for each in summary.splits.values()]
    found = [row[name] for row in rows for name in metrics if name in row]
    if len(metrics) < 2 or not found:
        return scored_shares(summary, metrics)
    low, high = (f"{100 * share:.0f}" for share in (min(found), max(found)))
    return [f"{low} to {high} % scored" if low != high else f"{low} % scored"]


def _protocol(summary: Summary) -> str:
    chosen = summary.provenance["evaluation"]
    names = [each for each in ("frames", "cuts", "episodes") if chosen.get(each) is not None]
    words = [summary.protocol, *(f"{chosen[name]} {name}" for name in names)]
    if (given := given_frames(summary)) > 1:
        words.append(f"{given} given frames")
    return ", ".join(words)


def _place(summary: Summary) -> float:
    """Sort key: the model's headline score in the first split; lower is better."""
    value = next(iter(summary.splits.values())).scores.rows["model"][summary.headline].value
    sign = -1 if summary.metrics[summary.headline].higher_is_better else 1
    return float("inf") if value is None else sign * value
