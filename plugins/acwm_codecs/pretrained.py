"""Loads pretrained autoencoders from a folder or from the Hub, with strict checks."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import huggingface_hub
from diffusers.configuration_utils import ConfigMixin
from diffusers.models.modeling_utils import ModelMixin
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from acwm_core.errors import DataError
from acwm_core.files import check_fetched, disk_error, parse_json
from acwm_core.model.shapes import check_finite

CONFIGURATION, TENSORS = "config.json", "diffusion_pytorch_model.safetensors"
SUBFOLDER = "vae"
"""Folder of the autoencoder in a repository or folder of a whole diffusion model."""

Autoencoder = TypeVar("Autoencoder", bound=ModelMixin)


def load_autoencoder(
    kind: type[Autoencoder],
    weights: str,
    codec: str,
    check: Callable[[Mapping[str, Any]], None] = lambda configuration: None,
) -> Autoencoder:
    """Load a float32 autoencoder from a folder, or from a Hub repository if no such folder exists.

    Args:
        kind: the diffusers class, which must match the configuration.
        weights: folder with `CONFIGURATION` and `TENSORS`, directly or in `SUBFOLDER`; or the id of
            a Hub repository with that subfolder.
        codec: name of the codec for messages.
        check: refuses configurations, before any weights are fetched or read.

    Raises:
        DataError: it does not exist, cannot be reached, or does not hold such an autoencoder.
    """
    local = Path(weights)
    folder = _inside(local, codec) if local.exists() else _downloaded(weights, CONFIGURATION, codec)
    try:
        configuration: Any = parse_json((folder / CONFIGURATION).read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"codec {codec!r}: {folder} cannot be read: {first_line(error)}") from None
    if isinstance(configuration, dict):
        check(cast(dict[str, Any], configuration))
    autoencoder = build(kind, configuration, folder / CONFIGURATION, codec)
    folder = folder if local.exists() else _downloaded(weights, TENSORS, codec)
    try:
        state = load_file(folder / TENSORS)
    except (OSError, ValueError, SafetensorError) as error:
        check_fetched(folder / TENSORS)
        raise DataError(f"codec {codec!r}: {folder} cannot be read: {first_line(error)}") from None
    load_strictly(autoencoder, state, folder / TENSORS, codec)
    return autoencoder


def build(kind: type[Autoencoder], configuration: Any, path: Path, codec: str) -> Autoencoder:
    """Create an untrained autoencoder; diffusers' defaults fill in missing configuration values.

    Raises:
        DataError: the configuration is of another class, or is invalid.
    """
    assert issubclass(kind, ConfigMixin)
    if not isinstance(configuration, dict):
        raise DataError(f"codec {codec!r}: {path} is not a configuration")
    found = configuration.get("_class_name", kind.__name__)
    if found != kind.__name__:
        raise DataError(f"codec {codec!r}: {path} is of an {found}, not an {kind.__name__}")
    try:
        return kind.from_config(configuration)  # pyright: ignore[reportReturnType]
    except Exception as error:  # a wrong value can fail anywhere in the constructor
        raise DataError(
            f"codec {codec!r}: {path} makes no {kind.__name__} ({first_line(error)})"
        ) from None


def load_strictly(
    autoencoder: ModelMixin, state: Mapping[str, Tensor], path: Path, codec: str
) -> None:
    """Load every tensor as float32.

    Raises:
        DataError: a tensor is missing, unexpected or has the wrong shape; names the tensor.
    """
    expected: dict[str, Tensor] = autoencoder.state_dict()
    for name in sorted({*expected, *state}):
        found = list(state[name].shape) if name in state else "missing"
        wanted = list(expected[name].shape) if name in expected else "absent"
        if found != wanted:
            raise DataError(
                f"codec {codec!r}: {path} does not hold its weights: {name} is {found}, "
                f"it should be {wanted}"
            )
    check_finite(path, state)
    autoencoder.load_state_dict({name: tensor.float() for name, tensor in state.items()})


def fingerprint(codec: str, autoencoder: ModelMixin) -> str:
    """A short hash of the weights, and of configuration values that differ from the defaults.

    So the same weights have the same fingerprint in every file format and diffusers version.
    """
    presets = inspect.signature(type(autoencoder).__init__).parameters
    configuration = {
        key: value
        for key, value in dict(autoencoder.config).items()
        if key in presets and _as_json(value) != _as_json(presets[key].default)
    }
    digest = hashlib.sha256(f"{codec} {_as_json(configuration)}".encode())
    for name, tensor in sorted(autoencoder.state_dict().items()):
        digest.update(f"{name} {list(tensor.shape)} {tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().flatten().numpy().tobytes())
    return digest.hexdigest()[:12]


def first_line(error: Exception) -> str:
    """The first line of an error's message, or else its class name."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def _as_json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)


def _inside(folder: Path, codec: str) -> Path:
    for candidate in (folder, folder / SUBFOLDER):
        if (candidate / CONFIGURATION).is_file():
            return candidate
    raise DataError(f"codec {codec!r}: {folder} is not a folder with {CONFIGURATION} and {TENSORS}")


def _downloaded(repository: str, name: str, codec: str) -> Path:
    """The folder of a repository's autoencoder in the local cache; downloads a missing file."""
    try:
        found = huggingface_hub.hf_hub_download(repository, name, subfolder=SUBFOLDER)
    except Exception as error:  # the HTTP library raises many kinds of errors
        if full := disk_error(error):
            where = f"the Hub's cache cannot be written ({full.strerror})"
            raise DataError(f"codec {codec!r}: {where}; set HF_HOME to another folder") from None
        raise DataError(
            f"codec {codec!r}: {repository} is not a local file or folder, and downloading it from "
            f"the Hub failed ({first_line(error).rstrip('. ')}); download it on another machine "
            "and set codec.weights to its folder"
        ) from None
    return Path(found).parent
