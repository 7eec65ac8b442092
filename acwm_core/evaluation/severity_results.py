"""Curves of error against severity, as files of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acwm_core.data.atomic import written_whole
from acwm_core.episode import FactorValue
from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, MetricInfo, Scores

SEVERITY = "severity"
"""Folder of curves, and of the data they are made of, below ``RUN/evaluation``."""


@dataclass(frozen=True)
class SeverityPoint:
    """Scores at one value of the factor.

    Attributes:
        value: of the factor, in all episodes.
        severity: 0 inside training, 1 at the furthest value that the environment declares.
        in_train: whether the model was trained on such values.
        scores: of the rows model, copy and codec (and truth where states are read from video).
        checksum: of the episodes.
    """

    value: FactorValue
    severity: float
    in_train: bool
    scores: Scores
    checksum: str


@dataclass(frozen=True)
class SeverityCurve:
    """``RUN/evaluation/severity/FACTOR.json``.

    Attributes:
        factor: its name.
        description: what it is.
        unit: its unit.
        kind: ``continuous`` or ``discrete``.
        train: low and high of training, or the training values.
        ood: intervals, or values, that the environment declares out of distribution.
        episodes: at each value; the same starts, as far as the factor leaves them alone.
        metrics: what was measured.
        headline: the metric that heads it.
        points: in the order asked for.
        left_out: ends of the range asked for that the factor cannot take.
        provenance: as in ``summary.json``.
    """

    factor: str
    description: str
    unit: str
    kind: str
    train: list[Any]
    ood: list[Any]
    episodes: int
    metrics: dict[str, MetricInfo]
    headline: str
    points: list[SeverityPoint]
    left_out: list[float]
    provenance: dict[str, Any]

    @property
    def text(self) -> str:
        """What to sweep for the same points: ``factors.NAME=VALUE,VALUE``."""
        return f"factors.{self.factor}={','.join(str(point.value) for point in self.points)}"

    def write(self, run: Path) -> None:
        """Write it into the folder of a run."""
        from pydantic import TypeAdapter

        with written_whole(run / FOLDER / SEVERITY / f"{self.factor}.json") as partial:
            text = TypeAdapter(SeverityCurve).dump_json(self, indent=1)
            partial.write_bytes(text + b"\n")


def curves_of(run: Path, weights: str) -> list[SeverityCurve]:
    """The curves of a run that are of weights with this hash.

    Raises:
        DataError: a file is from another version of acwm.
    """
    return [each for each in read_severity(run) if each.provenance["weights_sha256"] == weights]


def read_severity(run: Path) -> list[SeverityCurve]:
    """The curves of a run, by the name of their factor; none if there are none.

    Raises:
        DataError: a file is from another version of acwm.
    """
    from pydantic import TypeAdapter, ValidationError

    curves: list[SeverityCurve] = []
    for path in sorted((run / FOLDER / SEVERITY).glob("*.json")):
        try:
            curves.append(TypeAdapter(SeverityCurve).validate_json(path.read_bytes()))
        except ValidationError:
            raise DataError(
                f"{path} is not of this version of acwm: run `acwm evaluate {run} "
                f"--sweep factors.{path.stem}=…` again"
            ) from None
    return curves
