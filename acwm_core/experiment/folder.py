"""The folder of an experiment, and `experiment.json`, by which a report knows what lies in it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError

FILE = "experiment.json"

SUMMARY = Path("evaluation", "summary.json")
"""What a run folder holds once it is evaluated."""

FORMAT = 1
"""Version of `FILE`."""


@dataclass(frozen=True)
class ExperimentFolder:
    """The paths of an experiment.

    Attributes:
        path: the folder, e.g. ``experiments/conditioning``.
    """

    path: Path

    @property
    def file(self) -> Path:
        """What the experiment is, for its report."""
        return self.path / FILE

    @property
    def runs(self) -> Path:
        """The run folders, if no other place was asked for."""
        return self.path / "runs"

    @property
    def report(self) -> Path:
        """The report of all runs."""
        return self.path / "report.html"

    @property
    def logs(self) -> Path:
        """What every step printed, and what became of it."""
        return self.path / "logs"

    @property
    def scripts(self) -> Path:
        """The scripts of SLURM jobs."""
        return self.path / "slurm"


@dataclass(frozen=True)
class Cell:
    """A cell of an experiment's table.

    Attributes:
        row: its label.
        column: its label, ``""`` if the table has one column only.
        recipe: what was trained,
        overrides: and how it was changed.
        runs: the run folders, one per seed and in their order; one that failed or has yet to start
            is missing, or holds no evaluation.
    """

    row: str
    column: str
    recipe: str
    overrides: tuple[str, ...]
    runs: tuple[Path, ...]


@dataclass(frozen=True)
class Experiment:
    """A table of runs, finished or not.

    Attributes:
        name: of its file, e.g. ``conditioning``.
        title: heads the table.
        caption: says what is compared.
        table: key of the published table that it repeats, if any.
        rows: labels in their order.
        columns: labels in their order; ``("",)`` for one without a name.
        groups: rows by a heading that they share, in order; empty for none.
        seeds: with which each cell is trained.
        cells: row by row; a row may lack a column.
    """

    name: str
    title: str
    caption: str
    table: str | None
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    seeds: tuple[int, ...]
    cells: tuple[Cell, ...]

    def cell(self, row: str, column: str) -> Cell | None:
        """The cell of a row and a column, if there is one."""
        for cell in self.cells:
            if (cell.row, cell.column) == (row, column):
                return cell
        return None

    @property
    def runs(self) -> list[Path]:
        """All run folders once, row by row."""
        return list(dict.fromkeys(run for cell in self.cells for run in cell.runs))

    def write(self, folder: Path) -> None:
        """Write ``experiment.json``; run folders are told relative to `folder`, if they can be."""
        values = asdict(self)
        for cell in values["cells"]:
            cell["runs"] = [_relative(run, folder) for run in cell["runs"]]
        with written_whole(folder / FILE) as partial:
            text = json.dumps({"format": FORMAT, **values}, indent=1, ensure_ascii=False)
            partial.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def read(cls, folder: str | Path) -> Experiment:
        """Read what `write` wrote.

        Raises:
            DataError: the folder holds no experiment, or one of another version.
        """
        file = Path(folder) / FILE
        try:
            values = json.loads(file.read_text(encoding="utf-8"))
            if values["format"] == FORMAT:
                return _experiment(values, Path(folder))
        except (FileNotFoundError, NotADirectoryError):
            raise DataError(f"{folder} holds no experiment: it has no {FILE}") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(f"{file} is damaged ({type(error).__name__}: {error})") from None
        raise DataError(f"{file} was written by another version of acwm")


def is_experiment(folder: str | Path) -> bool:
    """Whether a folder holds an experiment."""
    return (Path(folder) / FILE).is_file()


def evaluated_runs(folder: str | Path) -> list[Path]:
    """The runs of an experiment's folder that hold an evaluation.

    Raises:
        DataError: the folder holds no experiment, or nothing of it is evaluated.
    """
    experiment = Experiment.read(folder)
    found = [run for run in experiment.runs if (run / SUMMARY).is_file()]
    if not found:
        raise DataError(f"no run of {folder} is evaluated yet")
    return found


def _experiment(values: Mapping[str, Any], folder: Path) -> Experiment:
    cells = [
        Cell(
            cell["row"],
            cell["column"],
            cell["recipe"],
            tuple(cell["overrides"] if "overrides" in cell else cell["words"]),
            tuple(folder / run for run in cell["runs"]),
        )
        for cell in values["cells"]
    ]
    return Experiment(
        name=values["name"],
        title=values["title"],
        caption=values["caption"],
        table=values["table"],
        rows=_texts(values["rows"]),
        columns=_texts(values["columns"]),
        groups={heading: _texts(rows) for heading, rows in values["groups"].items()},
        seeds=tuple(values["seeds"]),
        cells=tuple(cells),
    )


def _texts(values: Sequence[str]) -> tuple[str, ...]:
    return tuple(values)


def _relative(run: Path, folder: Path) -> str:
    run, folder = run.absolute(), folder.absolute()
    return str(run.relative_to(folder) if run.is_relative_to(folder) else run)
