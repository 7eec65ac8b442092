"""`Estimate`: a number with its interval."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """A number with its bootstrap 95 % confidence interval over episodes.

    Anything that is not finite (the PSNR of a perfect prediction) is None.
    """

    value: float | None
    low: float | None = None
    high: float | None = None


def finite(value: float) -> float | None:
    """The number for JSON, which has no infinity."""
    return float(value) if math.isfinite(value) else None
