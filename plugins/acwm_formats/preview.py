"""Shows what a data folder holds: facts as a dict, a contact sheet, and a video of episodes."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.pictures import Picture, join
from acwm_core.data.video import write_mp4
from acwm_core.env.episode import Episode, Split
from acwm_core.errors import AcwmWarning, DataError
from acwm_core.files import writable, written_whole
from acwm_formats.sheets import (
    GAP,
    Label,
    action_shares,
    contact_sheet,
    legend,
    play_together,
    tinted,
)


def describe(path: str | Path) -> dict[str, Any]:
    """Describe the data folder `path`, ready for JSON. It may still be unfinished.

    Returns:
        The card's `environment` (name), `summary`, `frame_size`, `fps`, `horizon`, `seed`,
        `factors`, `versions`, `source` (of recorded data), and `splits`, which has for each split:
        `episodes` (requested), `made`, `shards`, `frames`, `lengths` (shortest and longest),
        `bytes`, `actions` (statistics, once finished) and, for a simulated `ood_test`, the number
        of episodes with each `ood_label`.

    Raises:
        DataError: there is no dataset, or it is damaged.
    """
    path = Path(path)
    card = DatasetCard.read(path)
    values = card.to_dict()
    environment: dict[str, Any] = values["environment"]
    return {
        "path": str(path),
        "environment": environment["name"],
        **{name: environment[name] for name in ("summary", "frame_size", "fps", "horizon")},
        **{name: values[name] for name in ("seed", "factors", "exploration", "shift")},
        **{name: values[name] for name in ("versions", "source")},
        "splits": {split: _describe_split(path, card, split) for split in card.splits},
    }


def preview(
    path: str | Path, out: str | Path, *, episodes: int = 4, columns: int = 8
) -> tuple[Path, Path]:
    """Draw the first episodes of every split.

    Args:
        path: the data folder.
        out: folder to write to.
        episodes: number of episodes per split.
        columns: moments of each episode on the contact sheet; fewer for wide frames.

    Returns:
        The paths of ``out/preview.png``, with a row of moments per episode, and of
        ``out/preview.mp4``, in which these episodes play side by side. Both show the split, number
        and shifted factor of each episode, its masks if there are any, and its actions within
        their bounds.

    Raises:
        DataError: there is no dataset, it is unfinished, none of the episodes can be read, or `out`
            cannot be written.
    """
    out = writable(Path(out), folder=True, option="--out")
    card = DatasetCard.read(path)
    first = list(_first_episodes(path, card, episodes))
    if not first:
        raise DataError(f"none of the first episodes of {path} can be read: run `acwm data check`")
    labels, samples = [label for label, _ in first], [episode for _, episode in first]
    masked = any(episode.masks.any() for episode in samples)
    pairs = [
        [episode.video, *([tinted(episode.video, episode.masks)] * masked)] for episode in samples
    ]
    curves = [action_shares(episode.actions, card.environment.action) for episode in samples]
    keys = {"actions:": card.environment.action.names}
    keys |= {"masks:": card.environment.instances[1:]} if masked else {}
    out.mkdir(parents=True, exist_ok=True)
    sheet, video = out / "preview.png", out / "preview.mp4"
    moments = contact_sheet(labels, [join(pair, down=True) for pair in pairs], columns, curves)
    with written_whole(sheet) as partial:
        Image.fromarray(_explained(moments, keys)).save(partial, "png")
    frames = play_together(labels, [join(pair) for pair in pairs], None, curves)
    write_mp4(video, (_explained(frame, keys) for frame in frames), fps=card.environment.fps)
    return sheet, video


def _first_episodes(
    path: str | Path, card: DatasetCard, episodes: int
) -> Iterator[tuple[Label, Episode]]:
    """The first episodes of every split that can be read, with their labels."""
    for split in card.splits:
        dataset = EpisodeDataset(path, split)
        for index in range(min(episodes, len(dataset))):
            if why := dataset.damage(index):
                left = f"episode {index} of {split} is left out: {why}"
                warnings.warn(left, AcwmWarning, stacklevel=2)
                continue
            episode = dataset[index]
            yield Label(f"{split} {index}", episode.ood_label or ""), episode


def _explained(picture: Picture, keys: Mapping[str, Sequence[str]]) -> Picture:
    """The picture, and below it what the colours of actions and masks stand for."""
    width = picture.shape[1]
    legends = (legend(title, names, width) for title, names in keys.items())
    return join([picture, *legends], down=True, gap=GAP)


def _describe_split(path: Path, card: DatasetCard, split: Split) -> dict[str, Any]:
    records = Manifest(path / split, card.splits[split]).ordered()
    lengths = [length for record in records for length in record.lengths]
    facts: dict[str, Any] = {
        "episodes": card.splits[split],
        "made": sum(record.episodes for record in records),
        "shards": len(records),
        "frames": sum(lengths),
        "lengths": [min(lengths), max(lengths)] if lengths else [],
        "bytes": sum(record.size for record in records),
        "actions": dict(card.actions.get(split, {})),
    }
    whole = facts["made"] == facts["episodes"]
    if not card.source and split == "ood_test" and whole:  # recorded shifts are not labelled
        dataset = EpisodeDataset(path, split)
        labels = Counter(_label(dataset, index) for index in range(len(dataset)))
        facts["ood_labels"] = dict(sorted(labels.items()))
    return facts


def _label(dataset: EpisodeDataset, index: int) -> str:
    try:
        return dataset.about(index)["ood_label"] or "none"
    except DataError:
        return "nothing that can be read"
