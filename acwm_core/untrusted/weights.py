"""Read the metadata of a safetensors file, which may come from anyone."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from safetensors import SafetensorError, safe_open

from acwm_core.errors import DataError
from acwm_core.untrusted.json_values import parse_json


def training_record(path: Path) -> dict[str, Any]:
    """How the weights in a file were made (data, seed, steps); empty if the file does not say.

    Raises:
        DataError: the file is damaged, or its training record is malformed.
    """
    try:
        with cast(Any, safe_open)(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
        record: object = parse_json(metadata.get("training", "{}"))
        if isinstance(record, dict):
            return cast(dict[str, Any], record)
        why = "it is no mapping"
    except (OSError, SafetensorError, ValueError) as error:
        why = str(error)
    raise DataError(f"{path} does not say how its weights were made ({why})")
