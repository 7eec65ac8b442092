"""The scores of several models side by side, and the main table of a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from acwm_core.evaluation.protocol import PublishedRow
from acwm_core.evaluation.results import Estimate, MetricInfo, Summary
from acwm_core.evaluation.views import metric_and_view
from acwm_report.run import EvaluatedRun, described
from acwm_report.table import Cell, Column, Row, Scale, Table
from acwm_report.titles import clips_title, split_title

ModelScores = Mapping[tuple[str, str], Estimate]
"""A model's scores by split and metric."""


CAPTION = "▼: worse out of distribution than in distribution, by more than the intervals allow."


@dataclass(frozen=True)
class ScoreGrid:
    """Columns of scores, and the cells of each model in them."""

    places: Sequence[tuple[str, str]]  # split and metric of each column
    metrics: Mapping[str, MetricInfo]  # all of them
    scales: Mapping[str, Scale]  # by metric

    @classmethod
    def of(cls, models: Sequence[ModelScores], metrics: Mapping[str, MetricInfo]) -> ScoreGrid:
        """A grid for models, with as many digits as the smallest score of each metric needs."""
        scales: dict[str, Scale] = {}
        for name, info in metrics.items():
            scores = [score for model in models for (_, of), score in model.items() if of == name]
            values = (abs(each.value) for each in scores if each.value)
            smallest = min(filter(math.isfinite, values), default=None)
            scales[name] = Scale.of([smallest], info)
        splits = dict.fromkeys(split for model in models for split, _ in model)
        return cls([(split, name) for split in splits for name in metrics], metrics, scales)

    def columns(self, heading: str | None = None) -> list[Column]:
        """The columns; with several grids, `heading` distinguishes the columns of this one."""
        columns: list[Column] = []
        for split, name in self.places:
            metric, view = metric_and_view(name)
            group = " · ".join(filter(None, (heading, split_title(split), view)))
            key = ("_" if heading is None else " ").join(filter(None, (heading, split, name)))
            columns.append(Column.of(self.metrics[metric], self.scales[name], key, group))
        return columns

    def cells(self, scores: ModelScores) -> list[Cell]:
        """A model's scores, marked where they are worse out of distribution than in it."""
        cells: list[Cell] = []
        for split, name in self.places:
            score, near = scores.get((split, name)), scores.get(("ind_test", name))
            worse = False
            if split == "ood_test" and score and near and None not in (score.value, near.value):
                change = (score.value or 0) - (near.value or 0)
                loss = -change if self.metrics[name].higher_is_better else change
                worse = loss > math.hypot(_reach(score), _reach(near))
            cells.append(Cell.of(score, self.scales[name], worse=worse))
        return cells


def _reach(score: Estimate) -> float:
    """Half the interval; 0 if there is none, as for published scores."""
    if score.low is None or score.high is None:
        return 0.0
    return (score.high - score.low) / 2


def model_scores(summary: Summary) -> ModelScores:
    """The scores of the row ``model``, by split and metric."""
    splits = summary.splits.items()
    return {(s, name): score for s, x in splits for name, score in x.scores.rows["model"].items()}


def published_scores(row: PublishedRow | None) -> ModelScores:
    """The scores of a published row, without intervals; empty if there is no row."""
    splits = row.scores.items() if row else ()
    return {(s, name): Estimate(value) for s, scores in splits for name, value in scores.items()}


def compared_metrics(summaries: Sequence[Summary]) -> dict[str, MetricInfo]:
    """The pixel metrics that were measured; only the published ones, if there are any.

    Of single views, it is only the one that ranks clips.
    """
    metrics = {name: info for each in summaries for name, info in described(each.metrics).items()}
    pixels = {name: info for name, info in metrics.items() if info.reads == "pixels"}
    headlines = {each.headline for each in summaries}
    named = {name: metric_and_view(name) for name in pixels}
    pixels = {n: i for n, i in pixels.items() if not named[n][1] or named[n][0] in headlines}
    quoted = [published_scores(each.published.row) for each in summaries if each.published]
    published = {name for scores in quoted for _, name in scores}
    return {n: info for n, info in pixels.items() if n in published} or pixels


def shortcomings(summary: Summary) -> list[str]:
    """Phrases for a model whose training has not ended, and for predictions that are not finite."""
    found = {s: each.scores.failures() for s, each in summary.splits.items()}
    failures = [f"{split_title(split)}: {phrase}" for split, phrase in found.items() if phrase]
    return [phrase for phrase in (summary.unfinished, *failures) if phrase]


def scored_shares(summary: Summary, metrics: Iterable[str]) -> list[str]:
    """A phrase for each of these metrics and split with the share that is scored of the model."""
    found = {split: each.scores.shares.get("model", {}) for split, each in summary.splits.items()}
    return [
        f"{split_title(split)}: {100 * shares[name]:.0f} % of {name} scored"
        for split, shares in found.items()
        for name in metrics
        if name in shares
    ]


def main_table(runs: Sequence[EvaluatedRun]) -> Table | None:
    """One line per run with the published figures below it; None without pixel metrics."""
    summaries = [run.summary for run in runs]
    metrics = compared_metrics(summaries)
    if not metrics:
        return None
    quoted = [each.published for each in summaries]
    models = [model_scores(each) for each in summaries]
    figures = [published_scores(each.row if each else None) for each in quoted]
    grid = ScoreGrid.of([*models, *figures], metrics)
    environments = [each.parts["env"] for each in summaries]
    rows: list[Row] = []
    for number, (run, summary) in enumerate(zip(runs, summaries, strict=True)):
        words = [environments[number].replace("_", " ").title(), summary.run]
        if environments.count(environments[number]) > 1:
            words.reverse()
        clips = {clips_title(each.scores) for each in summary.splits.values()}
        note = ", ".join([words[1], summary.protocol, *sorted(clips), *shortcomings(summary)])
        link = run.key if len(runs) > 1 else ""
        rows.append(Row(words[0], grid.cells(models[number]), note, strong=True, link=link))
        published = quoted[number]
        if published and published not in quoted[number + 1 : number + 2]:
            row = published.row
            note = f"{row.citation}, {row.label}: {' '.join(filter(None, (row.column, row.row)))}"
            note += ", other components" * (not published.same_parts)
            rows.append(Row("published", grid.cells(figures[number]), note, muted=True))
    caption = CAPTION
    if any(quoted):
        caption += (
            " In grey, published figures of the same or the nearest setting, measured on other "
            "data: they show how hard a task is, not who is better."
        )
    return Table("", grid.columns(), rows, "Environment", caption, name="main")
