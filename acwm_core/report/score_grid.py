"""Scores of several models below one another: splits and metrics across, one scale per metric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from acwm_core.evaluation.published import PublishedRow
from acwm_core.evaluation.results import Estimate, MetricInfo, Summary
from acwm_core.report.run import EvaluatedRun, clips_title, split_title
from acwm_core.report.table import Cell, Column, Row, Scale, Table

ModelScores = Mapping[str, Mapping[str, Estimate]]
"""A model's scores by split and metric."""

CAPTION = "▼: worse out of distribution than in distribution."

PUBLISHED = (
    " In grey, published figures of the same or the nearest setting, measured on data of their "
    "own: they say how hard a task is, not who is better."
)


@dataclass(frozen=True)
class ScoreGrid:
    """Columns of scores, and the cells of models below them.

    Attributes:
        splits: headings over the columns.
        metrics: below each of them.
        scales: by metric.
    """

    splits: Sequence[str]
    metrics: Mapping[str, MetricInfo]
    scales: Mapping[str, Scale]

    @classmethod
    def of(cls, models: Sequence[ModelScores], metrics: Mapping[str, MetricInfo]) -> ScoreGrid:
        """A grid for models, in as many digits as the smallest score of each metric needs."""
        scales: dict[str, Scale] = {}
        for name, info in metrics.items():
            rows = [row for scores in models for row in scores.values() if name in row]
            values = [abs(row[name].value or 0.0) for row in rows]
            smallest = min(filter(None, values), default=None)
            scales[name] = Scale.of([smallest], info.unit, info.factor)
        splits = list(dict.fromkeys(split for scores in models for split in scores))
        return cls(splits, metrics, scales)

    def columns(self, heading: str | None = None) -> list[Column]:
        """The columns; `heading` tells those of one of several grids from the others'."""
        joint = "_" if heading is None else " "
        return [
            Column.of(
                info,
                self.scales[name],
                joint.join(filter(None, (heading, split, name))),
                " · ".join(filter(None, (heading, split_title(split)))),
            )
            for split in self.splits
            for name, info in self.metrics.items()
        ]

    def cells(self, scores: ModelScores) -> list[Cell]:
        """A model's scores, marked where they are worse out of distribution than in it."""
        return [
            Cell.of(
                scores.get(split, {}).get(name),
                self.scales[name],
                worse=split == "ood_test" and self._worse(scores, name),
            )
            for split in self.splits
            for name in self.metrics
        ]

    def _worse(self, scores: ModelScores, name: str) -> bool:
        near, far = (scores.get(s, {}).get(name) for s in ("ind_test", "ood_test"))
        if not near or not far or near.value is None or far.value is None:
            return False
        higher = self.metrics[name].higher_is_better
        return far.value < near.value if higher else far.value > near.value


def model_scores(summary: Summary) -> ModelScores:
    """What the model scored."""
    return {split: each.scores.rows["model"] for split, each in summary.splits.items()}


def compared_metrics(summaries: Sequence[Summary]) -> dict[str, MetricInfo]:
    """The metrics of pixels that were measured; of those, if any are, the published ones."""
    metrics = {name: info for each in summaries for name, info in each.metrics.items()}
    pixels = {name: info for name, info in metrics.items() if info.reads == "pixels"}
    quoted = [each.published.row.scores for each in summaries if each.published]
    published = {name for scores in quoted for row in scores.values() for name in row}
    return {n: info for n, info in pixels.items() if n in published} or pixels


def published_scores(row: PublishedRow | None) -> ModelScores:
    """The figures of a published row, which have no intervals; empty without one."""
    if row is None:
        return {}
    return {s: {n: Estimate(value) for n, value in each.items()} for s, each in row.scores.items()}


def main_table(runs: Sequence[EvaluatedRun]) -> Table | None:
    """One line per run, the published figures below it; None without metrics of pixels."""
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
        note = ", ".join([words[1], summary.protocol, *sorted(clips)])
        link = run.key if len(runs) > 1 else ""
        rows.append(Row(words[0], grid.cells(models[number]), note, strong=True, link=link))
        published = quoted[number]
        if published and published not in quoted[number + 1 : number + 2]:
            row = published.row
            name = " ".join(filter(None, (row.column, row.row)))
            note = f"{row.citation}, {row.label}: {name}"
            note += ", other components" * (not published.same_parts)
            rows.append(Row("published", grid.cells(figures[number]), note, muted=True))
    caption = CAPTION + PUBLISHED * any(quoted)
    return Table("", grid.columns(), rows, "Environment", caption, name="main")
