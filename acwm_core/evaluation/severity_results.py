"""What ``--sweep factors.NAME=VALUES`` asks for, and the curves it leaves. Free of torch."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from acwm_core.episode import REGIONS, Factor, FactorValue
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.evaluation.facts import Name, Provenance
from acwm_core.evaluation.results import FOLDER, MetricInfo, Scores
from acwm_core.recipe.text import parse
from acwm_core.untrusted import read_json

SEVERITY = "severity"
"""Folder of curves, and of the data they are made of, below ``RUN/evaluation``."""

POINTS = 7
"""Values of a continuous range, if nothing else is said."""

MAX_POINTS = 100

MAX_VALUE = 1e300
"""Of a value, so that distances between values are finite."""

EXAMPLE = "write factors.NAME=LOW..HIGH, factors.NAME=LOW..HIGH:POINTS or factors.NAME=VALUE,VALUE"

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})(?::(\d{{1,9}}))?")


@dataclass(frozen=True)
class Sweep:
    """The values of one factor to evaluate at, and the ends of a range that it cannot take."""

    factor: Factor
    values: tuple[FactorValue, ...]
    left_out: tuple[float, ...] = ()


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

    factor: Name
    description: str
    unit: str
    kind: str
    train: list[Any]
    ood: list[Any]
    episodes: int
    metrics: dict[Name, MetricInfo]
    headline: Name
    points: Annotated[list[SeverityPoint], Field(min_length=1)]
    left_out: list[float]
    provenance: Provenance

    @property
    def text(self) -> str:
        """What to sweep for the same points: ``factors.NAME=VALUE,VALUE``."""
        return f"factors.{self.factor}={','.join(str(point.value) for point in self.points)}"


def read_severity(run: Path, weights: str = "") -> list[SeverityCurve]:
    """The curves of a run by the name of their factor, or only those of weights with this hash.

    Raises:
        DataError: a file is from another version of acwm.
    """
    curves: list[SeverityCurve] = []
    for path in sorted((run / FOLDER / SEVERITY).glob("*.json")):
        try:
            curves.append(read_json(path, SeverityCurve, "a curve"))
        except DataError as error:
            again = f"run `acwm evaluate {run} --sweep factors.{path.stem}=…` again"
            raise DataError(f"{error}: {again}") from None
    return [c for c in curves if weights in ("", c.provenance["weights_sha256"])]


def parse_sweep(text: str, factors: Iterable[Factor]) -> Sweep:
    """Read ``factors.friction=0.1..1.2:8``, ``factors.cube_count=1..6``, ``factors.light=a,b``.

    A range of a continuous factor is cut into evenly spaced values, both ends included. A range of
    numbers that are listed stands for those that lie within, or with points, where they are whole,
    for so many evenly spaced whole ones (``factors.grain_count=3000..6000:4``).

    Raises:
        RecipeError: no such factor, no such values, or fewer than two of them.
    """
    name, equals, asked = text.removeprefix("factors.").partition("=")
    if not text.startswith("factors.") or not equals:
        raise RecipeError(f"{text!r} sweeps no factor: {EXAMPLE}")
    known = {factor.name: factor for factor in factors}
    if name not in known:
        raise RecipeError(f"there is no factor {name!r}{suggest(name, list(known))}")
    match = _RANGE.fullmatch(asked.strip())
    sweep = _range(known[name], match, text) if match else _listed(known[name], asked, text)
    if len(sweep.values) < 2:
        raise RecipeError(f"{text!r} has fewer than two values that {name} can take: {EXAMPLE}")
    return sweep


def _range(factor: Factor, match: re.Match[str], text: str) -> Sweep:
    low, high = float(match[1]), float(match[2])
    points = int(match[3]) if match[3] else None
    if max(abs(low), abs(high)) > MAX_VALUE:
        raise RecipeError(f"{text!r}: give ends between -{MAX_VALUE:g} and {MAX_VALUE:g}")
    if low >= high:
        raise RecipeError(f"{text!r}: {match[1]} must lie below {match[2]}")
    if points is not None and not 2 <= points <= MAX_POINTS:
        raise RecipeError(f"{text!r}: give 2 to {MAX_POINTS} points")
    if factor.kind == "continuous":
        spaced = np.linspace(low, high, points or POINTS)
        return Sweep(factor, tuple(float(f"{v:.6g}") for v in spaced))
    if not factor.counts and (points or any(isinstance(v, str) for v in factor.values)):
        listed = ", ".join(map(str, factor.values))
        raise RecipeError(f"{text!r}: {factor.name} has the values {listed} and none in between")
    numbers = sorted(factor.values, key=float)
    least, most = float(numbers[0]), float(numbers[-1])
    if points:  # so many whole ones, as far as there are any
        spaced = np.linspace(low, high, points).clip(least, most).round().astype(int).tolist()
        left_out = [end for end in (low, high) if not least <= end <= most]
        return Sweep(factor, tuple(dict.fromkeys(spaced)), tuple(left_out))
    inside = [value for value in numbers if low <= float(value) <= high]
    left_out = [end for end in (low, high) if end not in numbers]
    return Sweep(factor, tuple(inside), tuple(left_out))


def _listed(factor: Factor, asked: str, text: str) -> Sweep:
    values: list[FactorValue] = []
    for part in asked.split(","):
        value: Any = parse(part, f"a value of {text!r}")
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        known = abs(value) <= MAX_VALUE if number else isinstance(value, str)  # nan is not
        if not known or value in REGIONS:
            raise RecipeError(f"{text!r}: {part.strip()!r} is not a value of a factor; {EXAMPLE}")
        values.append(factor.draw(value, np.random.default_rng(0)))
    return Sweep(factor, tuple(dict.fromkeys(values)))
