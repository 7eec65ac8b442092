"""Checkpoints: one file, or a folder into which every process writes its shard of the tensors.

Both hold the same data under the same names, and both sharded and other training can read either. A
new checkpoint is written beside the old one and then replaces it: one of them is always intact.
"""

from __future__ import annotations

import io
import os
import pickle
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import IO, Any, cast

import torch
import torch.distributed.checkpoint as dcp
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.strategies import Strategy
from torch import Tensor
from torch.distributed.checkpoint import metadata
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.filesystem import FileSystemReader, _StorageInfo  # pyright: ignore[reportPrivateUsage]
from torch.distributed.checkpoint.metadata import Metadata, StorageMeta
from torch.serialization import _get_layout  # pyright: ignore

from acwm_core.data.shards import UNREADABLE
from acwm_core.errors import TrainingError
from acwm_core.untrusted import read_bytes

META = "meta.pt"
"""File in a folder with everything but the tensors of the model and the optimiser."""

WEIGHTS, STATES = "model.", "optimizer."
"""Prefixes of the tensors in a folder."""

_SHARE = re.compile(r"__\d+_\d+\.distcp")

_FORMATS: Any = metadata._MEM_FORMAT_ENCODING  # pyright: ignore[reportPrivateUsage]


def _format(owner: Any, name: str) -> Any:
    """In place of `getattr`, by which Python before 3.11.4 pickles the members of an enum."""
    if owner is not _FORMATS:
        raise ValueError(f"it names {name} of {owner}, which is not run")
    return _FORMATS[name]


_INDEX: dict[str, Any] = {"pathlib.PosixPath": type(Path()), "builtins.getattr": _format} | {
    f"{each.__module__}.{each.__qualname__}": each
    for each in cast(
        list[Any],
        [
            *(metadata.Metadata, metadata.TensorStorageMetadata, metadata.TensorProperties),
            *(metadata.ChunkStorageMetadata, metadata.MetadataIndex, metadata.StorageMeta),
            *(_FORMATS, _StorageInfo, torch.Size, _get_layout, type(Path())),
        ],
    )
}
"""Types allowed in the index of a folder, beside number types."""


def without_codec(state: Mapping[str, Any]) -> dict[str, Any]:
    """A training task's state dict without the frozen codec, which the run's recipe names."""
    return {name: value for name, value in state.items() if name.split(".")[1] != "codec"}


def last_whole(path: Path) -> Path | None:
    """The checkpoint `path`, or its predecessor if a process died while replacing it."""
    return next((found for found in (path, _old(path)) if found.exists()), None)


def read_details(path: Path) -> dict[str, Any]:
    """The entries of a checkpoint such as ``global_step``, without reading the tensors."""
    details = _loaded(path / META if path.is_dir() else path, mmap=True)
    if not isinstance(details.get("global_step"), int):
        raise _damaged(path, "it does not say its step")
    return details


def check_sums(path: Path) -> None:
    """Compare the bytes of a checkpoint with the CRC-32 checksums that PyTorch stores in it.

    PyTorch itself does not check them when reading: it would continue with damaged data.

    Raises:
        TrainingError: a checksum does not match.
    """
    try:
        _check_archive(path / META if path.is_dir() else path)
        if path.is_dir():  # every tensor is a separate archive
            for part in PlainReader(path).read_metadata().storage_data.values():
                with (path / part.relative_path).open("rb") as file:
                    file.seek(part.offset)
                    _check_archive(io.BytesIO(file.read(part.length)))
    except (zipfile.BadZipFile, zlib.error, struct.error, OSError, *UNREADABLE) as error:
        raise TrainingError(
            f"{path} is damaged ({error}): restore it from a backup, or remove it and train again"
        ) from None


def _check_archive(file: Path | IO[bytes]) -> None:
    with zipfile.ZipFile(file) as archive:
        if name := archive.testzip():
            raise zipfile.BadZipFile(f"{name} has another checksum than when it was written")


def read_whole(path: Path) -> dict[str, Any]:
    """Read a checkpoint of either kind, in the form of Lightning's single files, on the CPU.

    Raises:
        TrainingError: it is damaged, or holds more than numbers and text, which is not executed.
    """
    if path.is_file():
        return _loaded(path)
    try:
        return _read_folder(path)
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise _damaged(path, f"{type(error).__name__}: {error}") from error


def _read_folder(path: Path) -> dict[str, Any]:
    checkpoint = read_details(path)
    stored = cast(Any, PlainReader(path).read_metadata()).state_dict_metadata
    tensors = {
        name: torch.empty(kind.size, dtype=kind.properties.dtype) for name, kind in stored.items()
    }
    read_shares(path, tensors, no_dist=True)
    checkpoint["state_dict"] = weights = dict[str, Tensor]()
    states: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(WEIGHTS):
            weights[name.removeprefix(WEIGHTS)] = value
        else:
            parameter, _, key = name.removeprefix(STATES).rpartition(".")
            states.setdefault(parameter, {})[key] = value
    groups: list[dict[str, Any]] = checkpoint.pop("optimizer_groups")
    names = [name for group in groups for name in group["params"]]
    numbers = {name: number for number, name in enumerate(names)}
    numbered = {
        "state": {numbers[name]: state for name, state in states.items()},
        "param_groups": [{**g, "params": [numbers[name] for name in g["params"]]} for g in groups],
    }
    checkpoint["optimizer_states"] = [numbered]
    return checkpoint


class PlainReader(FileSystemReader):
    """Reads a folder that may hold only numbers: its index is unpickled with an allow-list."""

    def read_metadata(self, *args: Any, **kwargs: Any) -> Metadata:
        """The index of the tensors, which PyTorch itself would unpickle without restrictions.

        Raises:
            TrainingError: it holds anything but descriptions of tensors in files of the folder.
        """
        file = Path(cast(Any, self).path) / ".metadata"
        try:
            found: Any = _Index(io.BytesIO(read_bytes(file))).load()
            places, tensors = found.storage_data, found.state_dict_metadata.values()
            if not all(_SHARE.fullmatch(place.relative_path) for place in places.values()):
                raise ValueError("it names files elsewhere")
            claimed = sum(prod(each.size) * each.properties.dtype.itemsize for each in tensors)
            if claimed > sum(each.stat().st_size for each in file.parent.iterdir()):
                raise ValueError(f"it claims {claimed} bytes, more than there are")
        except Exception as error:  # a forged file can make the parser raise anything
            raise _damaged(file, f"{type(error).__name__}: {error}") from error
        found.storage_meta = StorageMeta(load_id=self.load_id)
        return cast(Metadata, found)


class _Index(pickle.Unpickler):
    """Unpickles the allowed types of a folder's index, and refuses every other name."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """One of `_INDEX`, or a `torch.dtype`."""
        found: Any = _INDEX.get(f"{module_name}.{global_name}")
        if found is None and module_name == "torch":
            found = getattr(torch, global_name, None)
            found = found if isinstance(found, torch.dtype) else None
        if found is None:
            raise ValueError(f"it names {module_name}.{global_name}, which is not run")
        return found


def read_shares(path: Path, tensors: dict[str, Tensor], *, no_dist: bool = False) -> None:
    """Read this process's shard of a folder into `tensors`, in place.

    Raises:
        TrainingError: it is damaged, or of another model.
    """
    reader = PlainReader(path)
    reader.read_metadata()  # raise its errors here: PyTorch would wrap them in a long traceback
    try:
        cast(Any, dcp).load(tensors, storage_reader=reader, no_dist=no_dist)
    except CheckpointException as error:
        first = next(iter(error.failures.values()), (error, None))[0]
        raise _damaged(path, f"{type(first).__name__}: {first}") from error


def _loaded(file: Path, *, mmap: bool = False) -> dict[str, Any]:
    """The dict in a file of `torch.save`, read without executing anything in it."""
    try:
        found: Any = torch.load(file, map_location="cpu", mmap=mmap, weights_only=True)
        if not isinstance(found, dict):
            raise TypeError("it is not a dict")
    except Exception as error:  # a forged file can make the parsers raise anything
        raise _damaged(file, f"{type(error).__name__}: {error}") from error
    return cast(dict[str, Any], found)


def _damaged(path: Path, why: str) -> TrainingError:
    short = " ".join(why.split())[:200]
    return TrainingError(f"the checkpoint {path} cannot be read ({short})")


def write_folder(
    path: Path, checkpoint: Mapping[str, Any], optimizer: Mapping[str, Any], strategy: Strategy
) -> None:
    """Write a checkpoint together with all other processes, each its shard.

    Args:
        path: the folder, on a file system that all processes share.
        checkpoint: Lightning's checkpoint, the same in all processes except for the
            ``state_dict``; its ``optimizer_states`` are left out.
        optimizer: the optimiser's state dict, by parameter names instead of numbers.
        strategy: strategy of all processes; the first one writes what they have in common.
    """
    partial = path.with_name(f".{path.name}.partial")
    if strategy.is_global_zero:
        _remove(partial)
        partial.mkdir(parents=True)
    strategy.barrier()
    tensors = flat(checkpoint["state_dict"], optimizer["state"])
    cast(Any, dcp).save(tensors, checkpoint_id=partial)
    if strategy.is_global_zero:
        apart = ("state_dict", "optimizer_states")
        details = {key: value for key, value in checkpoint.items() if key not in apart}
        _save(partial / META, {**details, "optimizer_groups": list(optimizer["param_groups"])})
        _put_in_place(partial, path)
    strategy.barrier()


class CheckpointFiles(TorchCheckpointIO):
    """Checkpoints of training with all weights on each device: written as one file."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write the file, and wait until it is on the disk."""
        path = Path(path)
        partial = path.with_name(f".{path.name}.partial")
        _remove(partial)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _save(partial, checkpoint)
        except BaseException:
            _remove(partial)
            raise
        _put_in_place(partial, path)

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint of either kind."""
        return read_whole(Path(path))


def flat(
    weights: Mapping[str, Tensor], states: Mapping[str, Mapping[str, Tensor]]
) -> dict[str, Tensor]:
    """The tensors of model and optimiser under their names in a folder."""
    tensors = {WEIGHTS + name: value for name, value in weights.items()}
    for name, values in states.items():
        tensors |= {f"{STATES}{name}.{key}": value for key, value in values.items()}
    return tensors


def _save(path: Path, values: Mapping[str, Any]) -> None:
    with path.open("wb") as file:
        torch.save(values, file)
        file.flush()
        os.fsync(file.fileno())


def _put_in_place(partial: Path, path: Path) -> None:
    old = _old(path)
    if partial.is_dir() or path.is_dir():  # a folder cannot be replaced in one system call
        if path.exists():
            _remove(old)
            path.rename(old)
        partial.rename(path)
    else:
        partial.replace(path)
    _remove(old)


def _old(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
