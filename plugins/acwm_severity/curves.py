"""Parsing of ``--sweep factors.NAME=VALUES``, and the resulting curves. Does not import torch."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from acwm_core.env.episode import REGIONS, Factor, FactorValue
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.evaluation.results import FOLDER, MetricInfo, SetSummary
from acwm_core.files import read_json
from acwm_core.recipe.text import parse

SEVERITY = "severity"
"""Folder below ``RUN/evaluation`` for curves and the data they are computed from."""

POINTS = 7
"""Default number of values for a continuous range."""

MAX_POINTS = 100

MAX_VALUE = 1e300
"""Largest absolute value of a factor, so that distances between values are finite."""

EXAMPLE = "write factors.NAME=LOW..HIGH, factors.NAME=LOW..HIGH:POINTS or factors.NAME=VALUE,VALUE"

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})(?::(\d{{1,9}}))?")


@dataclass(frozen=True)
class Sweep:
    """The values of one factor to evaluate, and requested range ends that it cannot take."""

    factor: Factor
    values: tuple[FactorValue, ...]
    left_out: tuple[float, ...] = ()


@dataclass(frozen=True)
class SeverityPoint:
    """The scores at one value of the factor.

    Attributes:
        value: value of the factor in all episodes.
        severity: 0 inside the training range, 1 at the furthest value the environment declares.
        in_train: whether the model was trained on such values.
        scores: scores of the rows model, copy and codec (and truth if states are read from video).
        checksum: checksum of the episodes.
    """

    value: FactorValue
    severity: float
    in_train: bool
    scores: SetSummary
    checksum: str


@dataclass(frozen=True)
class SeverityCurve:
    """``RUN/evaluation/severity/FACTOR.json``.

    Attributes:
        factor: name of the factor.
        description: what the factor is.
        unit: unit of the factor.
        kind: ``continuous`` or ``discrete``.
        train: low and high of training, or the training values.
        ood: intervals, or values, that the environment declares out of distribution.
        episodes: number of episodes at each value. They start alike at every value, as far as the
            factor allows.
        metrics: the metrics that were measured.
        headline: the metric shown first.
        points: in the requested order.
        left_out: requested range ends that the factor cannot take.
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
    points: Annotated[list[SeverityPoint], Field(min_length=1)]
    left_out: list[float]
    provenance: dict[str, Any]

    @property
    def text(self) -> str:
        """The argument of ``--sweep`` for the same points: ``factors.NAME=VALUE,VALUE``."""
        return f"factors.{self.factor}={','.join(str(point.value) for point in self.points)}"


def read_severity(run: Path, weights: str = "") -> list[SeverityCurve]:
    """The curves of a run, sorted by factor name; with `weights`, only those of this hash."""
    curves: list[SeverityCurve] = []
    for path in sorted((run / FOLDER / SEVERITY).glob("*.json")):
        try:
            curves.append(read_json(path, SeverityCurve, "a curve"))
        except DataError as error:
            evaluate = shlex.join(["acwm", "evaluate", str(run)])
            again = f"run `{evaluate} --sweep factors.{path.stem}=…` again"
            raise DataError(f"{error}: {again}") from None
    return [c for c in curves if weights in ("", c.provenance["weights_sha256"])]


def parse_sweep(text: str, factors: Iterable[Factor]) -> Sweep:
    """Read ``factors.friction=0.1..1.2:8``, ``factors.cube_count=1..6``, ``factors.light=a,b``.

    For a continuous factor, a range gives evenly spaced values, both ends included. For a factor
    with listed numbers, a range gives those within it. If these are integers, a range with a number
    of points gives that many evenly spaced integers (``factors.grain_count=3000..6000:4``).

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
        raise RecipeError(f"{text!r}: {factor.name} can only be {listed}")
    numbers = sorted(factor.values, key=float)
    least, most = float(numbers[0]), float(numbers[-1])
    if points:  # evenly spaced integers, without duplicates
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
        known = abs(value) <= MAX_VALUE if number else isinstance(value, str)  # not NaN
        if not known or value in REGIONS:
            raise RecipeError(f"{text!r}: {part.strip()!r} is not a value of a factor; {EXAMPLE}")
        values.append(factor.draw(value, np.random.default_rng(0)))
    return Sweep(factor, tuple(dict.fromkeys(values)))
