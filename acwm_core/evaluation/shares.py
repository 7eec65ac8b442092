"""Who makes the squared error of a model's predictions: the codec, the world, or the model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from acwm_core.evaluation.results import SetSummary
from acwm_core.evaluation.statistics import Estimate


@dataclass(frozen=True)
class ErrorShares:
    """Shares of the model's mean squared error, each at most 1.

    Errors of different origin are taken to add up, so this is a rough account.

    Attributes:
        codec: what the codec's reconstruction of the truth has: the part of the ``codec`` row.
        world: what the simulator has that starts slightly elsewhere: the part of the ``perturbed``
            row, of a few clips; None if it was not run.
    """

    codec: float
    world: float | None

    @property
    def model(self) -> float:
        """What is left for the model itself."""
        return max(0.0, 1 - self.codec - (self.world or 0))

    def __str__(self) -> str:
        """For example ``the codec alone makes 43 % of the squared error, the model 57 %``."""
        parts = [f"the codec alone makes {100 * self.codec:.0f} % of the squared error"]
        if self.world is not None:
            parts.append(f"the world's own doubt {100 * self.world:.0f} %")
        return ", ".join([*parts, f"the model {100 * self.model:.0f} %"])


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
