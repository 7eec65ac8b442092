"""The tables of an experiment: mean scores over seeds, and differences between its rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from acwm_core.errors import DataError
from acwm_core.evaluation.protocol import published_tables
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.statistics import ClipScores
from acwm_core.evaluation.storage import read_scores
from acwm_core.evaluation.summarise import tabulate
from acwm_core.recipe.trust import recipes_are_trusted, refuse_code
from acwm_experiment.table import RUN_SUMMARY, Experiment
from acwm_report.run import described
from acwm_report.scores import CAPTION, ScoreGrid, published_scores
from acwm_report.seeds import difference_over_seeds, over_seeds
from acwm_report.table import Cell, Row, Table

Place = tuple[str, str]
"""The row and column of a cell in an experiment."""


def evaluated_runs(folder: str | Path) -> list[Path]:
    """The evaluated runs of the experiment in a folder; there may be none if it has plans.

    Raises:
        DataError: the folder holds no experiment, or one without any result.
    """
    experiment = Experiment.read(folder)
    runs = [run for cell in experiment.cells for run in cell.runs]
    found = dict.fromkeys(run for run in runs if (run / RUN_SUMMARY).is_file())
    if not found and not any(plan.progress() for plan in experiment.plans):
        raise DataError(f"no run of {folder} is evaluated yet")
    return [*found]


def experiment_tables(
    experiment: Experiment | None, links: Mapping[Path, str] | None = None
) -> list[Table]:
    """The scores of an experiment, and the differences between rows tested on the same clips.

    Args:
        links: ids on the page that the row titles link to, by run folder.
    """
    if experiment is None:
        return []
    made = _ExperimentTables(experiment, links or {})
    return list(filter(None, [made.scores(), made.differences()]))


class _ExperimentTables:
    def __init__(self, experiment: Experiment, links: Mapping[Path, str]) -> None:
        self.experiment = experiment
        self._links = {folder.resolve(): link for folder, link in links.items()}
        self._groups = {row: title for title, rows in experiment.groups.items() for row in rows}
        table = published_tables().get(experiment.table or "")
        quoted = table.rows if table else ()
        self._quoted = {(row.row, row.column): row for row in quoted}
        self._runs = {
            (cell.row, cell.column): runs
            for cell in experiment.cells
            if (runs := [run for run in dict.fromkeys(cell.runs) if (run / RUN_SUMMARY).is_file()])
        }
        if not self._runs:
            raise DataError(f"no run of the experiment {experiment.name} is evaluated yet")
        self._summaries = {place: Summary.read(runs[0]) for place, runs in self._runs.items()}
        first = next(iter(self._summaries.values()))
        infos = described(first.metrics)
        pixels = [name for name, info in infos.items() if info.reads == "pixels"]
        names = dict.fromkeys([*pixels[:1], first.headline])
        if quoted:
            names = next(iter(quoted[0].scores.values()))
        from acwm_core.evaluation.score import build_metrics  # needs torch

        settings = first.provenance.get("evaluation", {})
        if not recipes_are_trusted():
            refuse_code({"evaluation": settings}, origin=f"the results of {first.run}")
        listed = settings.get("metrics", infos), settings.get("metric_options")
        self._metrics = build_metrics(*listed, only=[name for name in names if name in infos])
        self._clips = {place: self._read(runs) for place, runs in self._runs.items()}
        self._means = {
            place: {key: over_seeds(each) for key, each in scores.items()}
            for place, scores in self._clips.items()
        }
        models = [{key: each.mean for key, each in mean.items()} for mean in self._means.values()]
        shown = {name: infos[name] for name in self._metrics}
        self._grid = ScoreGrid.of([*models, *map(published_scores, quoted)], shown)

    def scores(self) -> Table:
        """Mean scores over seeds, with the published figures below."""
        experiment, rows = self.experiment, list[Row]()
        for row in experiment.rows:
            cells = [cell for column in experiment.columns for cell in self._cells((row, column))]
            group = self._groups.get(row, "")
            runs = (run for cell in experiment.cells if cell.row == row for run in cell.runs)
            link = next(filter(None, (self._links.get(run.resolve()) for run in runs)), "")
            rows.append(Row(row, cells, self._seeds(row), strong=True, group=group, link=link))
            quoted = [self._quoted.get((row, column)) for column in experiment.columns]
            if any(quoted):
                grids = (self._grid.cells(published_scores(each)) for each in quoted)
                rows.append(Row("published", list(chain(*grids)), group=group, muted=True))
        caption = (
            f"{experiment.caption} Mean over seeds, standard deviation over seeds (±) and 95 % "
            f"interval over seeds and episodes. {CAPTION}"
        )
        for source in list(self._quoted.values())[:1]:
            where = f"{source.citation}, {source.label}"
            caption += f" In grey, {where}: measured on other data. {source.note}"
        return self._table(experiment.title, rows, caption.strip(), experiment.name)

    def differences(self) -> Table | None:
        """Each row against the first on the same clips; None if no two rows share their clips."""
        first, *others = self.experiment.rows
        rows: list[Row] = []
        for row in others:
            cells = [
                self._difference((first, column), (row, column), *key)
                for column in self.experiment.columns
                for key in self._grid.places
            ]
            if any(cell.value is not None for cell in cells):
                rows.append(Row(row, cells, group=self._groups.get(row, "")))
        if not rows:
            return None
        caption = (
            f"Difference to {first} on the same clips: mean with its 95 % interval over seeds and "
            "episodes. Without 0 in the interval, the difference is significant at 5 %."
        )
        title = f"{self.experiment.title}: against {first}"
        return self._table(title, rows, caption, f"{self.experiment.name}_differences")

    def _table(self, title: str, rows: list[Row], caption: str, name: str) -> Table:
        columns = chain(*map(self._grid.columns, self.experiment.columns))
        return Table(title, list(columns), rows, caption=caption, name=name)

    def _read(self, runs: Sequence[Path]) -> dict[tuple[str, str], list[ClipScores]]:
        found: dict[tuple[str, str], list[ClipScores]] = {}
        for run in runs:
            results = [each for each in read_scores(run) if each.kind == "model"]
            for split in dict.fromkeys(each.split for each in results):
                there = [each for each in results if each.split == split]
                metrics = {n: m for n, m in self._metrics.items() if n in there[0].values}
                for name, column in tabulate(there, metrics)["model"].items():
                    found.setdefault((split, name), []).append(column)
        return found

    def _cells(self, place: Place) -> list[Cell]:
        means = self._means.get(place, {})
        cells = self._grid.cells({key: each.mean for key, each in means.items()})
        for index, (split, name) in enumerate(self._grid.places):
            scores = means.get((split, name))
            if scores and scores.deviation is not None:
                deviation = f"±{self._grid.scales[name].number(scores.deviation)}"
                interval = " · ".join(filter(None, (deviation, cells[index].interval)))
                cells[index] = replace(cells[index], interval=interval)
        return cells

    def _difference(self, first: Place, other: Place, split: str, name: str) -> Cell:
        ours, theirs = (self._clips.get(p, {}).get((split, name)) for p in (other, first))
        found = None
        if ours and theirs and self._tested_on(first, split) == self._tested_on(other, split):
            found = difference_over_seeds(ours, theirs)
        return Cell.of(found, self._grid.scales[name], signed=True)

    def _tested_on(self, place: Place, split: str) -> object:
        """A value that is equal for cells that were tested on the same clips."""
        facts = self._summaries[place].provenance
        return facts["dataset"]["checksums"].get(split), facts["evaluation"]

    def _seeds(self, row: str) -> str:
        cells = [cell for cell in self.experiment.cells if cell.row == row]
        counts = {len(self._runs.get((cell.row, cell.column), ())) for cell in cells}
        wanted = len(self.experiment.seeds)
        if counts == {wanted}:
            return f"{wanted} seed{'s' * (wanted > 1)}"
        return f"{min(counts)} of {wanted} seeds" + " in some cells" * (len(counts) > 1)
