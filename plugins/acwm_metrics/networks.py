"""Reads network weights from users' files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from acwm_core.errors import DataError
from acwm_core.files import check_fetched, load_plain
from acwm_core.model.shapes import check_finite


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read tensors by name from a PyTorch or safetensors file, without running code in it.

    Raises:
        DataError: the file is missing, damaged, or holds something else.
    """
    if path.suffix == ".safetensors" and path.is_file():
        try:
            tensors = load_file(path)
        except SafetensorError as error:
            check_fetched(path)
            raise DataError(f"{path} is damaged ({error})") from error
        check_finite(path, tensors)
        return tensors
    content = load_plain(path)
    if not isinstance(content, dict):
        raise DataError(f"{path} holds no weights by name")
    found = cast(dict[Any, Any], content)
    tensors = {str(name): value for name, value in found.items() if isinstance(value, Tensor)}
    check_finite(path, tensors)
    return tensors
