"""Where the squared error of predictions comes from: the codec, the world, or the model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from acwm_core.evaluation.results import SetSummary
from acwm_core.evaluation.statistics import Estimate


@dataclass(frozen=True)
class ErrorShares:
    """Shares of the model's mean squared error, each at most 1.

    Errors of different origin are assumed to add up, so the shares are approximate.

    Attributes:
        codec: the error of the codec's reconstruction of the truth (row ``codec``).
        world: irreducible uncertainty: the error of the simulator from a slightly different start
            (row ``perturbed``, of a few clips); None if it was not run.
    """

    codec: float
    world: float | None

    @property
    def model(self) -> float:
        """What is left for the model itself."""
        return max(0.0, 1 - self.codec - (self.world or 0))

    def __str__(self) -> str:
        """For example ``shares of the squared error: codec alone 43 %, model 57 %``."""
        parts = [f"codec alone {100 * self.codec:.0f} %"]
        if self.world is not None:
            parts.append(f"irreducible uncertainty {100 * self.world:.0f} %")
        parts.append(f"model {100 * self.model:.0f} %")
        return f"shares of the squared error: {', '.join(parts)}"


def error_shares(scores: SetSummary) -> ErrorShares | None:
    """The shares of a set of clips; None if no squared error was measured, or if it is 0."""
    model, codec, world = (
        squared_error(scores.rows.get(row, {})) for row in ("model", "codec", "perturbed")
    )
    if not model or codec is None or not math.isfinite(model):
        return None
    return ErrorShares(min(1.0, codec / model), None if world is None else min(1.0, world / model))


def squared_error(row: Mapping[str, Estimate]) -> float | None:
    """The mean squared error of a row, from the metric `mse` or else `psnr`; None without both."""
    error, psnr = (row[name].value if name in row else None for name in ("mse", "psnr"))
    if error is None and psnr is not None:
        return 10.0 ** (-psnr / 10)
    return error
