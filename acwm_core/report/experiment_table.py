"""The tables of an experiment: its cells over all seeds, and what they differ in."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from acwm_core.errors import DataError
from acwm_core.evaluation.clip_results import read_results, tabulate
from acwm_core.evaluation.published import PublishedRow, published_tables
from acwm_core.evaluation.results import Estimate, Summary
from acwm_core.evaluation.scoring import build_metrics
from acwm_core.experiment.folder import SUMMARY, Experiment, ExperimentCell
from acwm_core.report.main_table import SCALES, SPLITS, score_cell
from acwm_core.report.table import Cell as Shown
from acwm_core.report.table import Column, Row, Table
from acwm_core.report.wording import MISSING, Scale, metric_title, split_title
from acwm_core.statistics import (
    ClipScores,
    OverSeeds,
    difference_over_seeds,
    over_seeds,
)

METRICS = ("mse", "psnr")
"""Of the ablations' tables in the paper; of another table, those of its published rows."""

Place = tuple[str, str]
"""A split and a metric."""


@dataclass(frozen=True)
class CellScores:
    """What the evaluated runs of a cell scored.

    Attributes:
        summaries: of the runs that are evaluated.
        columns: the model's scores of each, by split and metric.
    """

    summaries: list[Summary]
    columns: dict[Place, list[ClipScores]]

    def clips(self, split: str) -> object:
        """What is equal for cells that were tested on the same clips."""
        facts = self.summaries[0].provenance
        return (facts["dataset"]["checksums"].get(split), facts["evaluation"])


class ExperimentTables:
    """Reads all runs of an experiment once, and lays them out.

    Args:
        experiment: with at least one evaluated run.
        links: ids on the page, by run folder, that the titles of rows lead to.

    Raises:
        DataError: nothing of it is evaluated, or a result cannot be read.
    """

    def __init__(self, experiment: Experiment, links: Mapping[Path, str] | None = None) -> None:
        self.experiment = experiment
        self._links = {folder.resolve(): link for folder, link in (links or {}).items()}
        table = published_tables().get(experiment.table or "")
        published = table.rows if table else ()
        self._published = {(row.row, row.column): row for row in published}
        names = tuple(published[0].scores[SPLITS[0]]) if published else METRICS
        self._metrics = build_metrics(names)
        self._places = [(split, name) for split in SPLITS for name in names]
        self._cells = {
            (cell.row, cell.column): scores
            for cell in experiment.cells
            if (scores := self._scores(cell)).summaries
        }
        if not self._cells:
            raise DataError(f"no run of the experiment {experiment.name} is evaluated yet")

    def tables(self) -> list[Table]:
        """The scores, and their differences where cells were tested on the same clips."""
        return [self.scores(), *filter(None, [self.differences()])]

    def scores(self) -> Table:
        """Means over seeds, with the published figures below."""
        experiment, rows = self.experiment, list[Row]()
        for row in experiment.rows:
            shown = [each for column in experiment.columns for each in self._row_cells(row, column)]
            rows.append(
                Row(
                    row,
                    self._seeds(row),
                    "",
                    shown,
                    strong=True,
                    group=self._group(row),
                    link=self._link(row),
                )
            )
            if any((row, column) in self._published for column in experiment.columns):
                quoted = [
                    each
                    for column in experiment.columns
                    for each in self._quoted(self._published.get((row, column)))
                ]
                rows.append(Row("published", "", "", quoted, group=self._group(row), quiet=True))
        return Table(
            experiment.title, self._columns(), rows, caption=self._caption(), name=experiment.name
        )

    def differences(self) -> Table | None:
        """Each row against the first on the same clips; None if no two can be compared so."""
        first, *others = self.experiment.rows
        rows: list[Row] = []
        for row in others:
            shown = [
                self._difference(first, row, column, place)
                for column in self.experiment.columns
                for place in self._places
            ]
            if any(cell.value is not None for cell in shown):
                rows.append(Row(row, "", "", shown, group=self._group(row)))
        if not rows:
            return None
        caption = (
            f"Beyond {first}, on the same clips: mean difference with its 95 % interval over seeds "
            "and episodes. An interval without 0 is larger than chance alone makes one in twenty."
        )
        title = f"{self.experiment.title}: against {first}"
        name = f"{self.experiment.name}_differences"
        return Table(title, self._columns(), rows, caption=caption, name=name)

    def _scores(self, cell: ExperimentCell) -> CellScores:
        runs = [run for run in dict.fromkeys(cell.runs) if (run / SUMMARY).is_file()]
        columns: dict[Place, list[ClipScores]] = {}
        summaries = [Summary.read(run) for run in runs]
        for run, summary in zip(runs, summaries, strict=True):
            results = read_results(run)
            for split, name in self._places:
                there = [r for r in results if r.split == split and r.kind == "model"]
                if there and name in summary.metrics:
                    table = tabulate(there, {name: self._metrics[name]})
                    columns.setdefault((split, name), []).append(table["model"][name])
        return CellScores(summaries, columns)

    def _over_seeds(self, row: str, column: str) -> dict[Place, OverSeeds]:
        cell = self._cells.get((row, column))
        columns = cell.columns if cell else {}
        return {place: over_seeds(runs) for place, runs in columns.items()}

    def _row_cells(self, row: str, column: str) -> Iterator[Shown]:
        found = self._over_seeds(row, column)
        cell = self._cells.get((row, column))
        infos = cell.summaries[0].metrics if cell else {}
        means: dict[str, dict[str, Estimate]] = {split: {} for split in SPLITS}
        for (split, name), scores in found.items():
            means[split][name] = scores.mean
        for split, name in self._places:
            shown = score_cell(means, split, name, infos)
            yield _with_deviation(shown, found.get((split, name)), SCALES.get(name))

    def _quoted(self, row: PublishedRow | None) -> Iterator[Shown]:
        for split, name in self._places:
            value = row.scores.get(split, {}).get(name) if row else None
            known = value is not None
            yield Shown.of(Estimate(value), SCALES[name]) if known else Shown(MISSING)

    def _difference(self, first: str, row: str, column: str, place: Place) -> Shown:
        split, name = place
        ours, theirs = (self._cells.get((each, column)) for each in (row, first))
        if ours is None or theirs is None or ours.clips(split) != theirs.clips(split):
            return Shown(MISSING)
        if place not in ours.columns or place not in theirs.columns:
            return Shown(MISSING)
        found = difference_over_seeds(ours.columns[place], theirs.columns[place])
        return Shown.of(found, SCALES.get(name) or Scale.of([found.value], ""), signed=True)

    def _columns(self) -> list[Column]:
        return [
            Column(
                metric_title(name),
                SCALES[name].unit if name in SCALES else "",
                "↑" if self._metrics[name].higher_is_better else "↓",
                group=" · ".join(filter(None, (column, split_title(split)))),
                key=" ".join(filter(None, (column, split, name))),
            )
            for column in self.experiment.columns
            for split, name in self._places
        ]

    def _seeds(self, row: str) -> str:
        counts = {
            len(self._cells[row, column].summaries) if (row, column) in self._cells else 0
            for column in self.experiment.columns
            if self.experiment.cell(row, column)
        }
        wanted = len(self.experiment.seeds)
        if counts == {wanted}:
            return f"{wanted} seed{'s' * (wanted > 1)}"
        return f"{min(counts)} of {wanted} seeds" + " in some cells" * (len(counts) > 1)

    def _link(self, row: str) -> str:
        """To the first run of the row."""
        runs = (run for cell in self.experiment.cells if cell.row == row for run in cell.runs)
        return next(filter(None, (self._links.get(run.resolve(), "") for run in runs)), "")

    def _group(self, row: str) -> str:
        groups: Mapping[str, Sequence[str]] = self.experiment.groups
        return next((heading for heading, rows in groups.items() if row in rows), "")

    def _caption(self) -> str:
        text = (
            "Mean over seeds, its deviation over seeds (±) and its 95 % interval over seeds and "
            "episodes. ▼: worse out of distribution than in distribution."
        )
        quoted = next(iter(self._published.values()), None)
        if quoted:
            text += (
                f" In grey, {quoted.citation}, {quoted.label}: measured on the paper's own "
                f"simulations at 240×240. {quoted.note}"
            )
        return " ".join(filter(None, (self.experiment.caption, text.strip())))


def _with_deviation(cell: Shown, scores: OverSeeds | None, scale: Scale | None) -> Shown:
    """The cell with the deviation over seeds before its interval."""
    if scores is None or scores.deviation is None or scale is None:
        return cell
    deviation = f"±{scale.number(scores.deviation)}"
    interval = " · ".join(filter(None, (deviation, cell.interval)))
    return Shown(cell.text, interval, cell.value, cell.low, cell.high, cell.mark, cell.link)
