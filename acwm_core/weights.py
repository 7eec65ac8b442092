"""What every file of weights must hold to be loaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from acwm_core.errors import DataError


def check_finite(path: Path, weights: Mapping[str, Tensor]) -> None:
    """Refuse weights whose every prediction would be NaN.

    Raises:
        DataError: one is not finite; names it.
    """
    for name, value in weights.items():
        if not value.isfinite().all():
            raise DataError(
                f"{path} holds weights that are not finite ({name}): take a copy of before, or "
                "train again with a lower learning rate"
            )
