"""The charts of a report: which curves, with which words around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from markupsafe import Markup

from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.results import Summary
from acwm_core.report.figures import Drawing, Line, line_chart, pair_chart, to_svg
from acwm_core.report.training_log import read_curve, smooth, training_lines
from acwm_core.report.wording import (
    OVER,
    ROWS,
    Scale,
    headline_scale,
    metric_scale,
    metric_title,
    row_title,
    split_title,
)

STATES = ("position_error", "mask_iou")
"""Metrics of states that are drawn over the horizon."""

RUN_COLOURS = 8
"""Number of colours that the page has for runs, ``--run1`` and so on."""


@dataclass(frozen=True)
class Chart:
    """A drawing and what a page says about it.

    Attributes:
        title: its heading.
        name: unique on the page, and the name of the files that it is exported to.
        drawing: what it shows.
        description: what it shows, for those who do not see it.
        legend: title, colour and whether it is dashed, per curve.
    """

    title: str
    name: str
    drawing: Drawing
    description: str
    legend: list[tuple[str, str, bool]]

    @property
    def svg(self) -> Markup:
        """Inline SVG."""
        return Markup(to_svg(self.name, self.drawing))


@dataclass(frozen=True)
class RunCharts:
    """The charts of one run.

    Attributes:
        key: unique on the page.
        summary: of the run.
        results: rows of the run.
        metrics: its ``metrics.csv``.
    """

    key: str
    summary: Summary
    results: Sequence[ClipResult]
    metrics: Path

    def horizon(self) -> list[Chart]:
        """The headline metric of each frame, one chart per split."""
        shown = _Horizon(self.summary, self.summary.headline, headline_scale(self.summary))
        return [
            shown.chart(f"{self.key}-horizon-{split}", split, shown.rows(split))
            for split in self.summary.splits
        ]

    def state_horizon(self) -> list[Chart]:
        """How far what is read of each frame is off, one chart per metric and split."""
        charts: list[Chart] = []
        for metric in STATES:
            if metric not in self.summary.metrics or metric == self.summary.headline:
                continue
            shown = _Horizon(self.summary, metric, metric_scale(self.summary, metric))
            for split in self.summary.splits:
                name = f"{self.key}-horizon-{metric.replace('_', '-')}-{split}"
                title = f"{metric_title(metric)}, {split_title(split).lower()}"
                chart = shown.chart(name, split, shown.rows(split))
                charts.append(replace(chart, title=title))
        return charts

    def pairs(self) -> list[Chart]:
        """Each episode with its own and with another's actions, one chart per split."""
        name = self.summary.headline
        label = axis_title(name, self.summary.metrics[name].unit)
        charts: list[Chart] = []
        for split in self.summary.splits:
            rows = [r for r in self.results if r.split == split]
            own, other = (
                [
                    r.values[name]
                    for r in sorted(rows, key=lambda r: (r.episode, r.start))
                    if r.kind == kind
                ]
                for kind in ("model", "shuffled")
            )
            drawing = pair_chart(
                other,
                own,
                "model",
                f"{label}, another episode’s actions",
                f"{label}, true actions",
            )
            pair = self.summary.splits[split].scores.paired["shuffled"][name]
            title = f"{split_title(split)}: {pair.better} of {pair.clips} better"
            about = f"{title} with the true actions than with {OVER['shuffled']}."
            charts.append(Chart(title, f"{self.key}-pairs-{split}", drawing, about, []))
        return charts

    def steps(self) -> Chart | None:
        """The headline metric against sampling steps, a curve per split; None without a sweep."""
        scale, name = headline_scale(self.summary), self.summary.headline
        colours = {"ind_test": "model", "ood_test": "shuffled"}
        lines: list[Line] = []
        for split, result in self.summary.splits.items():
            if result.steps is None:
                continue
            values = [point.scores[name].value for point in result.steps.points]
            lines.append(
                Line(
                    split_title(split),
                    colours.get(split, "run1"),
                    [point.steps for point in result.steps.points],
                    [None if value is None else value * scale.factor for value in values],
                )
            )
        if not lines:
            return None
        label = axis_title(name, scale.unit)
        drawing = line_chart(lines, "sampling steps", label, x_ticks=lines[0].x, points=True)
        about = f"{metric_title(name)} against the number of sampling steps."
        return Chart("Sampling steps", f"{self.key}-steps", drawing, about, legend_of(lines))

    def training(self) -> Chart | None:
        """The losses over the steps; None without a log."""
        lines = training_lines(self.metrics)
        return _training_chart(f"{self.key}-training", lines) if lines else None


def horizon_comparison(summaries: Sequence[Summary], names: Sequence[str]) -> list[Chart]:
    """The model's curve of every run over the copy of the first frame, per split they share.

    Args:
        summaries: of runs on one environment.
        names: of the runs.
    """
    first = summaries[0]
    charts: list[Chart] = []
    for split in first.splits:
        having = [
            (number, summary)
            for number, summary in enumerate(summaries)
            if split in summary.splits and first.headline in summary.metrics
        ]
        shown = _Horizon(first, first.headline, headline_scale(first))
        lines = [shown.line(split, "copy", row_title("copy"), "copy", dashed=True)] + [
            replace(shown, summary=summary).line(split, "model", names[number], run_colour(number))
            for number, summary in having
        ]
        charts.append(shown.chart(f"compared-horizon-{split}", split, lines))
    return charts


def training_comparison(logs: Sequence[tuple[str, Path]]) -> Chart | None:
    """The smoothed training loss of every run; None without logs."""
    lines: list[Line] = []
    for number, (run, file) in enumerate(logs):
        steps, losses = read_curve(file, "train/loss")
        if len(steps) > 1:
            lines.append(Line(run, run_colour(number), steps, smooth(losses)))
    return _training_chart("compared-training", lines) if lines else None


def run_colour(number: int) -> str:
    """The colour of the run of that number, from 0; they repeat when there are many."""
    return f"run{number % RUN_COLOURS + 1}"


@dataclass(frozen=True)
class _Horizon:
    """Draws a metric of each frame.

    Attributes:
        summary: of a run.
        metric: which of its metrics.
        scale: of its numbers.
    """

    summary: Summary
    metric: str
    scale: Scale

    def rows(self, split: str) -> list[Line]:
        """A curve for every row in which the metric is defined."""
        horizon = self.summary.splits[split].horizon
        return [
            self.line(split, kind, row_title(kind), kind, dashed=kind in ("codec", "truth"))
            for kind in reversed(ROWS)
            if any(value is not None for value in horizon.get(kind, {}).get(self.metric, ()))
        ]

    def line(self, split: str, kind: str, title: str, colour: str, *, dashed: bool = False) -> Line:
        """A curve from frame 1 on: frame 0 was given."""
        curve = self.summary.splits[split].horizon[kind][self.metric][1:]
        seconds = [(index + 1) / self.summary.environment["fps"] for index in range(len(curve))]
        scaled = [None if value is None else value * self.scale.factor for value in curve]
        return Line(title, colour, seconds, scaled, dashed)

    def chart(self, name: str, split: str, lines: Sequence[Line]) -> Chart:
        """The curves of a split."""
        label = axis_title(self.metric, self.scale.unit)
        drawing = line_chart(lines, "seconds after the first frame", label)
        ends = ", ".join(
            f"{line.title} {self.scale.number(last / self.scale.factor)}"
            for line in lines
            if (last := line.y[-1]) is not None
        )
        metric, where = metric_title(self.metric), split_title(split)
        about = f"{metric} of each frame, {where.lower()}; in the last frame {ends}."
        return Chart(where, name, drawing, about, legend_of(lines))


def _training_chart(name: str, lines: Sequence[Line]) -> Chart:
    drawing = line_chart(lines, "optimiser steps", "loss", log=True)
    ends = ", ".join(f"{line.title} {line.y[-1]:.3g}" for line in lines if not line.faint)
    about = f"Loss over the steps; at the end: {ends}."
    return Chart("Loss", name, drawing, about, legend_of(lines))


def axis_title(metric: str, unit: str) -> str:
    """A metric with its unit, along an axis."""
    return metric_title(metric) + (f" ({unit})" if unit else "")


def legend_of(lines: Sequence[Line]) -> list[tuple[str, str, bool]]:
    """Title, colour and whether it is dashed, of every curve that is not faint."""
    return [(line.title, line.colour, line.dashed) for line in reversed(lines) if not line.faint]
