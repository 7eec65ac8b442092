"""Reads files of `torch.save` without executing anything in them."""

from __future__ import annotations

import pickle
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.serialization import safe_globals

from acwm_core.errors import DataError

_scalar, _array = np.float64(0).__reduce__()[0], np.zeros(0).__reduce__()[0]
_PLAIN: list[Any] = [
    np.ndarray,
    np.dtype,
    *{type(np.dtype(code)) for code in "?bhilqBHILQefdSU"},
    # Under the names written by NumPy 2 and by NumPy 1.
    _scalar,
    _array,
    (_scalar, "numpy.core.multiarray.scalar"),
    (_array, "numpy.core.multiarray._reconstruct"),
]
"""Types allowed beyond those of `weights_only`: NumPy's numbers, and arrays of numbers or text."""


def load_plain(path: Path, *, on_disk: bool = False) -> object:
    """The numbers, text, tensors, lists and dicts in a file of `torch.save`.

    Args:
        on_disk: leave the tensors in the file until they are used, if its format allows this.

    Raises:
        DataError: it is missing, damaged, or holds anything else; nothing in it was executed.
    """
    if not path.is_file():
        raise DataError(f"{path} is missing")
    try:
        mapped = on_disk and zipfile.is_zipfile(path)  # before PyTorch 1.6 it was no zip
        with safe_globals(_PLAIN), warnings.catch_warnings(action="ignore"):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    except pickle.UnpicklingError as error:
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        what = f" ({found[1]})" if found else ""
        raise DataError(
            f"{path} holds more than numbers and text{what}, or is damaged: it was not loaded, and "
            "nothing in it was run"
        ) from error
    except Exception as error:  # a forged file can make the parsers raise anything
        raise DataError(f"{path} is damaged ({type(error).__name__})") from error
