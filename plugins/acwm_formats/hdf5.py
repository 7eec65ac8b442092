"""Export to HDF5: a file per split, bit for bit what the shards hold."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py

from acwm_core.data.formats import DatasetExporter, Export
from acwm_core.episode import Episode

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


class HDF5Exporter(DatasetExporter):
    """Write HDF5: a file per split, bit for bit what the dataset holds, with the ground truth."""

    def write(self, export: Export) -> None:
        """Write ``train.hdf5``, ``ind_test.hdf5`` and ``ood_test.hdf5``.

        Each holds a group per episode, ``episode_000012``, with

        * ``video``, uint8 ``[T, H, W, 3]``, and ``masks``, uint8 ``[T, H, W]``, a chunk per frame;
        * ``actions``, float32 ``[T, A]``, raw units; row i takes frame i to i + 1, the last is 0;
        * ``states/NAME``, ``[T, …]``, and ``contacts``, int32 rows (frame, id, id);
        * attributes ``spec``, ``factors`` (JSON) and ``ood_label`` (text, empty if there is none).

        The file's attributes are ``format`` ("acwm"), ``card`` (the dataset's, JSON) and
        ``episodes``.
        """
        for split, dataset in export.splits.items():
            with _PatientFile(export.folder / f"{split}.hdf5") as opened:
                with h5py.File(opened, "w") as file:
                    file.attrs["format"] = "acwm"
                    file.attrs["card"] = json.dumps(export.card.to_dict())
                    file.attrs["episodes"] = len(dataset)
                    for episode in export.episodes(split):
                        _write(file.create_group(f"episode_{episode.spec.index:06d}"), episode)
                        opened.check()
                opened.check()


class _PatientFile(io.FileIO):
    """A file that takes what the disk refuses, and says so when asked: HDF5 would crash of it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._refused: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write all of it, or, once the disk has refused, nothing."""
        rest = memoryview(data)
        try:
            while len(rest) and self._refused is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self._refused = error
        return len(data)

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size, if the disk lets it."""
        try:
            return super().truncate(size)
        except OSError as error:
            self._refused = error
            return size or 0

    def check(self) -> None:
        """Raise what the disk has refused."""
        if self._refused is not None:
            raise self._refused


def _write(group: Any, episode: Episode) -> None:
    for name, frames in {"video": episode.video, "masks": episode.masks}.items():
        group.create_dataset(name, data=frames, chunks=(1, *frames.shape[1:]), **COMPRESSION)
    group.create_dataset("actions", data=episode.actions)
    group.create_dataset("contacts", data=episode.contacts)
    for name, values in episode.states.items():
        group.create_dataset(str(Path("states", name)), data=values)
    group.attrs["spec"] = json.dumps(episode.spec.to_dict())
    group.attrs["factors"] = json.dumps(dict(episode.factors))
    group.attrs["ood_label"] = episode.ood_label or ""
