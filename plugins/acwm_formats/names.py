"""Names of files and datasets: their natural order, and one word for each."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

from acwm_core.errors import DataError
from acwm_core.plugins import catalog


def natural(name: str) -> list[tuple[int, str]]:
    """A key to sort names by, so that 2 comes before 10."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def folded(name: str) -> str:
    """A name without its case, and with composed letters: macOS writes ü as two characters."""
    return composed(name).casefold()


def composed(name: str) -> str:
    """A name in Unicode's NFC, in which equal names are equal."""
    return unicodedata.normalize("NFC", name)


def word(path: Path) -> str:
    """The name of a file or folder as one word, which is not that of a simulator."""
    name = path.resolve().name.partition(".")[0]
    plain = re.sub(r"\W+", "_", name).strip("_").lower() or "recorded"
    return f"{plain}_recorded" if plain in catalog().registry("environment") else plain


def is_action(name: str) -> bool:
    """Whether a column or array is called an action: action, actions, action_x, action.gripper."""
    return re.match(r"actions?(\W|_|\d|$)", name.lower()) is not None


def unread_note(root: Path, used: Iterable[Path]) -> list[str]:
    """A sentence for people about what else lies in the folder `root`; none if nothing does."""
    if not root.is_dir():
        return []
    others = sorted(
        path.name for path in {*root.iterdir()} - {*used} if not path.name.startswith((".", "_"))
    )
    names = f"{', '.join(others[:5])}{' …' * (len(others) > 5)}"
    return [f"Files that were not read: {names}."] if others else []


def words(text: str | None) -> tuple[str, ...]:
    """Names with a comma between."""
    return tuple(name.strip() for name in (text or "").split(",") if name.strip())


def exact(rate: float) -> Fraction:
    """A rate that was typed as a decimal; 29.97, 59.94 and the like are of NTSC.

    Raises:
        DataError: it is no number above 0.
    """
    if not 0 < rate < math.inf:
        raise DataError(f"a rate of {rate} frames per second: give a number above 0")
    for whole in (24, 30, 48, 60, 120):
        ntsc = Fraction(whole * 1000, 1001)
        if abs(rate - ntsc) < 0.005:
            return ntsc
    return Fraction(rate).limit_denominator(10**6)


def pair(numbers: tuple[int, ...] | None) -> tuple[float, float] | None:
    """Two numbers that were typed, as a range.

    Raises:
        DataError: they are not two, or the second is not the greater one.
    """
    if numbers is None:
        return None
    if len(numbers) != 2 or not numbers[0] < numbers[1]:
        raise DataError(f"--pixel-range {typed(numbers)}: give the values of black and of white")
    return float(numbers[0]), float(numbers[1])


def typed(numbers: tuple[int, ...] | None) -> str | None:
    """Numbers as they are typed."""
    return None if numbers is None else ",".join(map(str, numbers))
