"""The format HDF5: one file per split, with bit-exact data."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import h5py

from acwm_core.env.episode import Episode
from acwm_formats.format import Export, Format

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


class HDF5(Format):
    """HDF5: a file per split."""

    def write(self, export: Export) -> None:
        """Write HDF5: one file per split, with bit-exact data and the ground truth.

        Each file holds one group per episode, such as ``episode_000012``, with

        * ``video``, uint8 ``[T, H, W, 3]``, and ``masks``, uint8 ``[T, H, W]``, one chunk per
          frame;
        * ``actions``, float32 ``[T, A]``, raw units; row i leads from frame i to i + 1, the last
          row is 0;
        * ``states/NAME``, ``[T, …]``, and ``contacts``, int32 rows (frame, id, id);
        * attributes ``spec``, ``factors`` (JSON) and ``ood_label`` (text, empty if there is none).

        The attributes of the file are ``format`` ("acwm"), ``card`` (the dataset's card as JSON)
        and ``episodes`` (their number).
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

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """None: it is only written."""
        return {}


class _PatientFile(io.FileIO):
    """A file that stores disk errors until `check` is called, because HDF5 would crash on them."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self._refused: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write all data, or nothing after a disk error."""
        rest = memoryview(data)
        try:
            while len(rest) and self._refused is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self._refused = error
        return len(data)

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size of the file, if the disk allows it."""
        try:
            return super().truncate(size)
        except OSError as error:
            self._refused = error
            return size or 0

    def check(self) -> None:
        """Raise the stored disk error, if there is one."""
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
