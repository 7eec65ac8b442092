"""Loads weights: those that ship with the package, and others in the same format."""

from __future__ import annotations

import hashlib
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file

from acwm_core.errors import DataError
from acwm_core.files import check_fetched
from acwm_core.model.shapes import check_finite
from acwm_estimators.network import StateNetwork

FOLDER = Path(__file__).parent / "weights"


def load(network: StateNetwork, path: Path) -> None:
    """Load the weights from a file.

    Raises:
        DataError: the file does not exist, or holds the weights of another network.
    """
    try:
        state = {name: value.float() for name, value in load_file(path).items()}
        missing, unexpected = network.load_state_dict(state, strict=False)
    except FileNotFoundError:
        raise DataError(f"there is no weights file {path}") from None
    except (SafetensorError, RuntimeError) as error:
        check_fetched(path)
        reason = str(error).splitlines()[0]
        raise DataError(f"{path} does not hold an estimator's weights ({reason})") from error
    lacking = [name for name in missing if not name.endswith("num_batches_tracked")]
    if lacking or unexpected:
        name = (lacking + unexpected)[0]
        raise DataError(f"{path} holds the weights of another estimator: see {name!r}")
    check_finite(path, state)


def fingerprint(path: Path) -> str:
    """Hash of a weights file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
