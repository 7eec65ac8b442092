"""One program for NumPy's arrays and PyTorch's tensors, without importing PyTorch."""

from __future__ import annotations

import sys
from typing import Any, TypeVar

import numpy as np

Array = TypeVar("Array")
"""Arrays of NumPy, or tensors of PyTorch: a result is of the type of the argument."""


def real(values: Any) -> Any:
    """The values to compute with: an array of float64, or a tensor of float32 or more."""
    torch: Any = sys.modules.get("torch")
    if torch is not None and isinstance(values, torch.Tensor):
        wide = values.is_floating_point() and values.dtype.itemsize >= 4
        return values if wide else values.float()
    return np.asarray(values, np.float64)


def namespace(values: Any) -> Any:
    """The module with the functions for what `real` returned: ``numpy`` or ``torch``.

    For functions that both have, with the axis as a positional argument.
    """
    return np if isinstance(values, np.ndarray) else sys.modules["torch"]


def constant(numbers: Any, like: Any) -> Any:
    """Numbers to compute with beside `like`, which `real` returned."""
    array = np.asarray(numbers, np.float64)
    return array if isinstance(like, np.ndarray) else like.new_tensor(array.tolist())
