"""Checkpoints: one file, or a folder into which every process writes its shard of the tensors.

Both hold the same data under the same names, and both sharded and other training can read either. A
new checkpoint is written beside the old one and then replaces it: one of them is always intact.
"""

from __future__ import annotations

import io
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, cast

import torch
import torch.distributed.checkpoint as dcp
from torch import Tensor
from torch.distributed.checkpoint import metadata
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.filesystem import FileSystemReader

from acwm_core.errors import TrainingError
from acwm_core.files import written_whole

META = "meta.pt"
"""File in a folder with everything but the tensors of the model and the optimiser."""

_INDEX = {
    *("torch.Size", "torch.serialization._get_layout", "pathlib.PosixPath"),
    "torch.distributed.checkpoint.filesystem._StorageInfo",
    *(
        f"torch.distributed.checkpoint.metadata.{name}"
        for name in (
            *("Metadata", "TensorStorageMetadata", "TensorProperties", "_MEM_FORMAT_ENCODING"),
            *("ChunkStorageMetadata", "MetadataIndex", "StorageMeta"),
        )
    ),
}
"""Names allowed in the index of a folder, beside those of number types."""

WEIGHTS, STATES = "model.", "optimizer."
"""Prefixes of the tensors in a folder."""


def without_codec(state: Mapping[str, Any]) -> dict[str, Any]:
    """A training module's state dict without the frozen codec, which the run's recipe names."""
    return {name: value for name, value in state.items() if name.split(".")[1] != "codec"}


def last_whole(path: Path) -> Path | None:
    """The checkpoint `path`, or its predecessor if a process died while replacing it."""
    return next((place for place in (path, _old(path)) if place.exists()), None)


def read_details(path: Path) -> dict[str, Any]:
    """The entries of a checkpoint such as ``global_step``, without reading the tensors."""
    return _load(path / META if path.is_dir() else path, mmap=True)


def read_step(path: Path) -> int:
    """The number of optimiser steps behind a checkpoint.

    Raises:
        TrainingError: it is damaged.
    """
    step = read_details(path).get("global_step")
    if not isinstance(step, int) or step < 0:
        raise _damaged(path, ValueError(f"its global_step is {step!r}"))
    return step


def read_whole(path: Path) -> dict[str, Any]:
    """Read a checkpoint of either kind, in the form of Lightning's single files, on the CPU."""
    return _load(path) if path.is_file() else _read_folder(path)


def _load(file: Path, *, mmap: bool = False) -> dict[str, Any]:
    """The dict in a file of `torch.save`, read without executing anything in it."""
    try:
        content = torch.load(file, map_location="cpu", mmap=mmap, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise _damaged(file, error) from error
    if not isinstance(content, dict):
        raise _damaged(file, TypeError(f"it holds a {type(content).__name__}"))
    return cast(dict[str, Any], content)


def _damaged(path: Path, error: BaseException) -> TrainingError:
    why = " ".join(str(error).split())[:200]
    return TrainingError(
        f"{path} is damaged ({why}): restore it from a backup, or remove it and train again"
    )


def check_sums(path: Path) -> None:
    """Compare the bytes of a checkpoint with the CRC-32 checksums that PyTorch stores in it.

    PyTorch itself does not check them when reading: it would continue with damaged data.

    Raises:
        TrainingError: a checksum does not match.
    """
    try:
        _check_archive(path / META if path.is_dir() else path)
        if path.is_dir():  # every tensor is a separate archive
            for part in _Reader(path).read_metadata().storage_data.values():
                with (path / part.relative_path).open("rb") as file:
                    file.seek(part.offset)
                    _check_archive(io.BytesIO(file.read(part.length)))
    except (zipfile.BadZipFile, zlib.error, struct.error, OSError, NotImplementedError) as error:
        raise _damaged(path, error) from error


def _check_archive(file: Path | IO[bytes]) -> None:
    with zipfile.ZipFile(file) as archive:
        if name := archive.testzip():
            raise zipfile.BadZipFile(f"{name} has another checksum than when it was written")


def _read_folder(path: Path) -> dict[str, Any]:
    checkpoint = read_details(path)
    stored = cast(Any, _Reader(path).read_metadata()).state_dict_metadata
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


def read_shares(path: Path, tensors: dict[str, Tensor], *, no_dist: bool = False) -> None:
    """Read this process's shard of a folder into `tensors`, in place.

    Raises:
        TrainingError: it is damaged, or of another model.
    """
    reader = _Reader(path)
    reader.read_metadata()  # raise its errors here: PyTorch would wrap them in a long traceback
    try:
        cast(Any, dcp).load(tensors, storage_reader=reader, no_dist=no_dist)
    except CheckpointException as error:
        first = next(iter(error.failures.values()), (error, None))[0]
        raise _damaged(path, first) from error


class _Reader(FileSystemReader):
    """Reads a folder. PyTorch itself would unpickle whatever its index holds."""

    def read_metadata(self, *args: Any, **kwargs: Any) -> metadata.Metadata:
        """The index of the tensors.

        Raises:
            TrainingError: it is damaged, or holds more than descriptions of tensors in the folder.
        """
        file = Path(cast(Any, self).path) / ".metadata"
        try:
            index: metadata.Metadata = _IndexUnpickler(io.BytesIO(file.read_bytes())).load()
        except (pickle.UnpicklingError, EOFError, LookupError, ValueError, OSError) as error:
            raise _damaged(file, error) from error
        files = cast(dict[Any, Any], index.storage_data).values()
        if any(Path(file.relative_path).name != file.relative_path for file in files):
            raise TrainingError(f"{file} names files of other folders")
        index.storage_meta = metadata.StorageMeta(load_id=self.load_id)
        return index


class _IndexUnpickler(pickle.Unpickler):
    """Unpickles what PyTorch writes into the index of a folder, and refuses every other name."""

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """One of `_INDEX`, or a `torch.dtype`."""
        name = f"{module_name}.{global_name}"
        if name == "builtins.getattr":  # by which Python before 3.11.4 pickles members of an enum
            return lambda _, member: metadata._MEM_FORMAT_ENCODING[member]  # pyright: ignore
        is_type = module_name == "torch" and isinstance(vars(torch).get(global_name), torch.dtype)
        if name in _INDEX or is_type:
            return super().find_class(module_name, global_name)
        raise pickle.UnpicklingError(f"it names {name}, which is not run")


def write_folder(
    path: Path, checkpoint: Mapping[str, Any], optimizer: Mapping[str, Any], strategy: Any
) -> None:
    """Write a checkpoint together with all other processes, each its shard.

    Args:
        path: the folder, on a file system that all processes share.
        checkpoint: Lightning's checkpoint, the same in all processes except for the
            ``state_dict``; its ``optimizer_states`` are left out.
        optimizer: the optimiser's state dict, by parameter names instead of numbers.
        strategy: Lightning's strategy; the first process writes what all have in common.
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
        with (partial / META).open("wb") as file:
            torch.save({**details, "optimizer_groups": list(optimizer["param_groups"])}, file)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            _set_aside(path)
        partial.rename(path)
        _remove(_old(path))
    strategy.barrier()


def write_file(path: Path, checkpoint: Mapping[str, Any]) -> None:
    """Write a checkpoint as one file, and wait until it is on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():  # no file can replace it in one system call
        _set_aside(path)
    with written_whole(path) as partial, partial.open("wb") as file:
        torch.save(checkpoint, file)
    _remove(_old(path))


def flat(
    weights: Mapping[str, Tensor], states: Mapping[str, Mapping[str, Tensor]]
) -> dict[str, Tensor]:
    """The tensors of model and optimiser under their names in a folder."""
    tensors = {WEIGHTS + name: value for name, value in weights.items()}
    for name, values in states.items():
        tensors |= {f"{STATES}{name}.{key}": value for key, value in values.items()}
    return tensors


def _set_aside(path: Path) -> None:
    """Keep the last checkpoint under another name until the new one is in its place."""
    _remove(_old(path))
    path.rename(_old(path))


def _old(path: Path) -> Path:
    return path.with_name(f".{path.name}.old")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
