"""A look into a data folder: facts as a plain dict, a contact sheet, and a film of episodes."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from acwm_core.data.card import DatasetCard
from acwm_core.data.contact_sheet import Label, contact_sheet, play_together
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.manifest import Manifest
from acwm_core.data.video import write_mp4
from acwm_core.episode import Split


def describe(path: str | Path) -> dict[str, Any]:
    """What the data folder `path` holds, JSON-ready, also while its generation is unfinished.

    Returns:
        The card's `environment` (name), `summary`, `frame_size`, `fps`, `horizon`, `seed`,
        `factors`, `versions`, `source` (of recorded data), and under `splits`, for each:
        `episodes` asked for, `made`, `shards`, `frames`, `bytes`, `actions` (statistics, once
        finished) and, for a simulated `ood_test`, how many episodes have each `ood_label`.

    Raises:
        DataError: there is no dataset, or it is damaged.
    """
    path = Path(path)
    card = DatasetCard.read(path)
    environment = card.environment
    return {
        "path": str(path),
        "environment": environment.name,
        "summary": environment.summary,
        "frame_size": list(environment.frame_size),
        "fps": environment.fps,
        "horizon": environment.horizon,
        "seed": card.seed,
        "factors": dict(card.factors),
        "versions": dict(card.versions),
        "source": dict(card.source),
        "splits": {split: _describe_split(path, card, split) for split in card.splits},
    }


def preview(
    path: str | Path, out: str | Path, *, episodes: int = 4, columns: int = 8
) -> tuple[Path, Path]:
    """Draw the first episodes of every split.

    Args:
        path: the data folder.
        out: the folder to write to; created with its parents.
        episodes: how many of each split.
        columns: moments of each episode on the contact sheet; of wide frames it shows fewer.

    Returns:
        ``out/preview.png``, a row of moments per episode, and ``out/preview.mp4``, in which all
        these episodes play side by side. Both say each one's split, number and shifted factor.

    Raises:
        DataError: there is no dataset, or it is unfinished or damaged.
    """
    card = DatasetCard.read(path)
    labels: list[Label] = []
    videos: list[NDArray[np.uint8]] = []
    for split in card.splits:
        dataset = EpisodeDataset(path, split)
        for index in range(min(episodes, len(dataset))):
            shifted = cast(str | None, dataset.about(index)["ood_label"])
            labels.append(Label(f"{split} {index}", shifted or ""))
            videos.append(dataset.video(index).transpose(0, 2, 3, 1))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    sheet, film = out / "preview.png", out / "preview.mp4"
    Image.fromarray(contact_sheet(labels, videos, columns)).save(sheet)
    write_mp4(film, play_together(labels, videos), fps=card.environment.fps)
    return sheet, film


def _describe_split(path: Path, card: DatasetCard, split: Split) -> dict[str, Any]:
    records = Manifest(path / split).ordered()
    facts: dict[str, Any] = {
        "episodes": card.splits[split],
        "made": sum(record.episodes for record in records),
        "shards": len(records),
        "frames": sum(record.frames for record in records),
        "bytes": sum(record.size for record in records),
        "actions": dict(card.actions.get(split, {})),
    }
    simulated = not card.source  # recorded shifts are not labelled
    if simulated and split == "ood_test" and facts["made"] == facts["episodes"]:
        dataset = EpisodeDataset(path, split)
        labels = (cast(str | None, dataset.about(i)["ood_label"]) for i in range(len(dataset)))
        facts["ood_labels"] = dict(sorted(Counter(label or "none" for label in labels).items()))
    return facts
