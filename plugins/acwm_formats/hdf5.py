"""Export to HDF5: a file per split, bit for bit what the shards hold."""

from __future__ import annotations

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
            with h5py.File(export.folder / f"{split}.hdf5", "w") as file:
                file.attrs["format"] = "acwm"
                file.attrs["card"] = json.dumps(export.card.to_dict())
                file.attrs["episodes"] = len(dataset)
                for episode in export.episodes(split):
                    _write(file.create_group(f"episode_{episode.spec.index:06d}"), episode)


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
