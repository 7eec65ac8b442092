"""Scores as the terminal shows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acwm_core.evaluation.results import Estimate


def estimate_text(estimate: Estimate, *, interval: bool = True) -> str:
    """``24.41 ±0.5``: four digits, of small ones two, and half the interval if there is one."""
    if estimate.value is None:
        return "–"
    digits = 4 if abs(estimate.value) >= 0.01 else 2  # small ones have zeros enough
    text = f"{estimate.value:#.{digits}g}"
    if interval and estimate.low is not None and estimate.high is not None:
        text += f" ±{(estimate.high - estimate.low) / 2:.1g}"
    return text
