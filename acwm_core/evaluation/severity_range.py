"""What ``--sweep factors.NAME=VALUES`` asks for, free of torch so that it is checked in no time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from acwm_core.episode import REGIONS, Factor, FactorValue
from acwm_core.errors import RecipeError, suggest
from acwm_core.recipe.text import parse

POINTS = 7
"""Values of a continuous range, if nothing else is said."""

MOST_POINTS = 100

LARGEST = 1e300
"""Of a value, so that distances between values are finite."""

EXAMPLE = "write factors.NAME=LOW..HIGH, factors.NAME=LOW..HIGH:POINTS or factors.NAME=VALUE,VALUE"

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})(?::(\d{{1,9}}))?")


@dataclass(frozen=True)
class Sweep:
    """The values of one factor to evaluate at.

    Attributes:
        factor: which.
        values: in order, none twice.
        left_out: ends of a range that the factor cannot take.
    """

    factor: Factor
    values: tuple[FactorValue, ...]
    left_out: tuple[float, ...] = ()


def parse_sweep(text: str, factors: Iterable[Factor]) -> Sweep:
    """Read ``factors.friction=0.1..1.2:8``, ``factors.cube_count=1..6``, ``factors.light=a,b``.

    A range of a continuous factor is cut into evenly spaced values, both ends included. A range of
    numbers that are listed stands for those that lie within, or with points, where they are whole,
    for so many evenly spaced whole ones (``factors.grain_count=3000..6000:4``).

    Args:
        text: what is asked for.
        factors: of the environment.

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


def refuse_repeated(sweeps: Iterable[Sweep]) -> None:
    """Refuse several sweeps of one factor, of which the last curve would replace the others.

    Raises:
        RecipeError: a factor is swept more than once.
    """
    names = [sweep.factor.name for sweep in sweeps]
    for name in names:
        if (times := names.count(name)) > 1:
            raise RecipeError(f"{name} is swept {times} times: list all its values in one sweep")


def _range(factor: Factor, match: re.Match[str], text: str) -> Sweep:
    low, high = float(match[1]), float(match[2])
    points = int(match[3]) if match[3] else None
    if max(abs(low), abs(high)) > LARGEST:
        raise RecipeError(f"{text!r}: give ends between -{LARGEST:g} and {LARGEST:g}")
    if low >= high:
        raise RecipeError(f"{text!r}: {match[1]} must lie below {match[2]}")
    if points is not None and not 2 <= points <= MOST_POINTS:
        raise RecipeError(f"{text!r}: give 2 to {MOST_POINTS} points")
    if factor.kind == "continuous":
        spaced = np.linspace(low, high, points or POINTS)
        return Sweep(factor, tuple(float(f"{v:.6g}") for v in spaced))
    if not factor.counts and (points or any(isinstance(v, str) for v in factor.values)):
        listed = ", ".join(map(str, factor.values))
        raise RecipeError(f"{text!r}: {factor.name} has the values {listed} and none in between")
    return _counted(factor, low, high, points)


def _counted(factor: Factor, low: float, high: float, points: int | None) -> Sweep:
    """The listed numbers within the range, or so many whole ones, as far as there are any."""
    numbers = sorted(factor.values, key=float)
    if points is None:
        inside = [value for value in numbers if low <= float(value) <= high]
        left_out = [end for end in (low, high) if end not in numbers]
        return Sweep(factor, tuple(inside), tuple(left_out))
    least, most = float(numbers[0]), float(numbers[-1])
    left_out = [end for end in (low, high) if not least <= end <= most]
    spaced = np.linspace(low, high, points).clip(least, most).round().astype(int)
    return Sweep(factor, tuple(dict.fromkeys(spaced.tolist())), tuple(left_out))


def _listed(factor: Factor, asked: str, text: str) -> Sweep:
    values: list[FactorValue] = []
    for part in asked.split(","):
        value: Any = parse(part, f"a value of {text!r}")
        if not _plain(value):
            raise RecipeError(f"{text!r}: {part.strip()!r} is no value of a factor; {EXAMPLE}")
        values.append(factor.draw(value, np.random.default_rng(0)))
    return Sweep(factor, tuple(dict.fromkeys(values)))


def _plain(value: Any) -> bool:
    """Whether it is a number that can be computed with, or a name."""
    if isinstance(value, str):
        return value not in REGIONS
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= LARGEST  # nan is not
