"""The folder of an experiment, which reports recognise by its `experiment.json`."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from acwm_core.errors import DataError
from acwm_core.files import parse_json, typed, written_whole
from acwm_planning.jobs import PlanningJob

EXPERIMENT_FILE = "experiment.json"

RUN_SUMMARY = Path("evaluation", "summary.json")
"""File that a run folder holds once it is evaluated."""

FORMAT = 1
"""Version of `EXPERIMENT_FILE`."""


@dataclass(frozen=True)
class ExperimentCell:
    """A cell of an experiment's table."""

    row: str  # label of its row
    column: str  # label of its column, ``""`` if the table has only one
    recipe: str  # the recipe that was trained
    overrides: tuple[str, ...]  # changes to the recipe
    # the run folders, one per seed and in their order. The folder of a run that failed or has not
    # started is missing or holds no evaluation. Empty before they are planned.
    runs: tuple[Path, ...] = ()

    @property
    def title(self) -> str:
        """Its row and column label."""
        return " · ".join(filter(None, (self.row, self.column)))


@dataclass(frozen=True)
class Experiment:
    """A table of runs, finished or not."""

    name: str  # name of its file, e.g. ``conditioning``
    title: str  # title of the table
    caption: str  # says what is compared
    table: str | None  # key of the published table that it reproduces, if any
    rows: tuple[str, ...]  # row labels in order
    columns: tuple[str, ...]  # column labels in order; ``("",)`` for a single unnamed one
    # rows under a common heading, in order; empty for none
    groups: Mapping[str, tuple[str, ...]]
    seeds: tuple[int, ...]  # seeds with which each cell is trained
    cells: tuple[ExperimentCell, ...]  # row by row; a row may lack a column
    plans: tuple[PlanningJob, ...] = ()  # tasks solved by planning, table by table

    def of_runs(self, runs: Collection[Path]) -> Experiment:
        """The same table with these runs only."""
        wanted = {run.resolve() for run in runs}
        kept = (tuple(run for run in cell.runs if run.resolve() in wanted) for cell in self.cells)
        cells = (replace(cell, runs=own) for cell, own in zip(self.cells, kept, strict=True))
        return replace(self, cells=tuple(cells))

    def write(self, folder: Path) -> None:
        """Write ``experiment.json``; paths inside `folder` are stored relative to it."""
        values, base = asdict(self), folder.absolute()

        def stored(path: Path) -> str:
            path = path.absolute()
            return str(path.relative_to(base) if path.is_relative_to(base) else path)

        for cell in values["cells"]:
            cell["runs"] = [*map(stored, cell["runs"])]
        for plan in values["plans"]:
            plan |= {name: stored(plan[name]) for name in ("run", "folder")}
        with written_whole(folder / EXPERIMENT_FILE) as partial:
            text = json.dumps({"format": FORMAT, **values}, indent=1, ensure_ascii=False)
            partial.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def read(cls, folder: str | Path) -> Experiment:
        """Read what `write` wrote.

        Raises:
            DataError: the folder holds no experiment, or one from another version, or damaged.
        """
        file = Path(folder) / EXPERIMENT_FILE
        try:
            values = parse_json(file.read_bytes())
            if values["format"] != FORMAT:
                raise DataError(f"{file} was written by another version of acwm")
            for cell in values["cells"]:
                cell["overrides"] = cell.get("overrides", cell.pop("words", None))  # old name
                cell["runs"] = [str(Path(folder, run)) for run in cell["runs"]]
            for plan in values.get("plans", ()):
                plan |= {name: str(Path(folder, plan[name])) for name in ("run", "folder")}
            return typed(values, cls)
        except (FileNotFoundError, NotADirectoryError):
            raise DataError(f"{folder} holds no experiment: it has no {EXPERIMENT_FILE}") from None
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise DataError(f"{file} is damaged ({type(error).__name__}: {error})") from None


def is_experiment(folder: str | Path) -> bool:
    """Whether a folder holds an experiment."""
    return (Path(folder) / EXPERIMENT_FILE).is_file()
