"""Export to the layout of the published ACWM-Phys release."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from acwm_core.data.exchange.exporting import Export
from acwm_core.data.exchange.metadata import write_metadata
from acwm_core.data.exchange.published import FOLDERS, METADATA, PLACES
from acwm_core.data.video import write_mp4

OTHERS = "others"
"""Category of environments that the release does not have."""


def write_published(export: Export) -> None:
    """Write ``CATEGORY/ENVIRONMENT/{ind_train,ind_test,ood_test}`` with videos and metadata.

    Videos are visually lossless H.264 (yuv420p, CRF 18), not bit-exact. Actions are normalised to
    [-1, 1] by the card's bounds; the last row, which leads to no frame, is zero. States, masks,
    contacts and factors have no place in the layout.
    """
    card = export.card.environment
    category, name = PLACES.get(card.name, (OTHERS, card.name))
    low, high = np.array(card.action.low), np.array(card.action.high)
    folders = {split: folder for folder, split in FOLDERS.items()}
    for split in export.splits:
        folder = export.folder / category / name / folders[split]
        folder.mkdir(parents=True)
        entries: list[dict[str, Any]] = []
        for episode in export.episodes(split):
            index = episode.spec.index
            video = f"episode_{index}.mp4"
            write_mp4(folder / video, episode.video, card.fps)
            normalised = np.clip(2 * (episode.actions - low) / (high - low) - 1, -1, 1)
            normalised[-1] = 0
            entries.append(
                {
                    "video_path": f"{category}/{name}/{folders[split]}/{video}",
                    "actions": torch.as_tensor(normalised, dtype=torch.float32),
                    "length": len(episode.video),
                    "seed": episode.spec.seed,
                    "episode_idx": index,
                }
            )
        write_metadata(folder / METADATA, entries)
