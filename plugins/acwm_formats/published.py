"""The published ACWM-Phys release, or anything in its layout: import and export."""

from __future__ import annotations

import functools
import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from acwm_core.data.video import write_mp4
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import Split
from acwm_core.errors import AcwmError, DataError
from acwm_core.files import inside
from acwm_core.plugins import catalog
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format
from acwm_formats.frames import VideoFrames, video_index
from acwm_formats.published_layout import (
    CITATION,
    ENVIRONMENTS,
    FOLDERS,
    METADATA,
    PARTS,
    PLACES,
    EpisodeMetadata,
    read_entries,
)
from acwm_formats.sources import files_in, guarded
from acwm_formats.timeline import ActionFacts, RecordedDataset, Samples, TimedRecording

LARGE = 1024  # square videos of this side are averaged down to `USUAL` by default
USUAL = 240
OTHERS = "others"  # category of environments that are not in the release


class Published(Format):
    """The published ACWM-Phys release, or anything in its layout."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is the folder of an environment, or holds some, one or two levels below."""
        return any(
            (place / METADATA).is_file()
            for below in ("", "*/", "*/*/")
            for name in FOLDERS
            for place in path.glob(f"{below}{name}")
        )

    @guarded
    def read(
        self, root: Path, *, follow_links: bool = False
    ) -> RecordedDataset | dict[str, RecordedDataset]:
        """Import the published ACWM-Phys release.

        ROOT is the folder of one environment, which becomes the dataset OUT, or a folder of several
        environments, each of which becomes a dataset OUT/NAME. Videos of 1024×1024 become 240×240
        unless --size says otherwise.

        Args:
            root: the folder of one environment, with some of ``ind_train``, ``ind_test`` and
                ``ood_test`` in it, or a folder one or two levels above.
            follow_links: Whether links may lead out of the folder.
        """
        root = Path(root)
        if _splits(root):
            return _dataset(root, follow_links)
        datasets: dict[str, RecordedDataset] = {}
        for folder in _folders(root):
            dataset = _dataset(folder, follow_links)
            name = dataset.name
            if name in datasets:
                raise DataError(f"{folder} is a second {name}: import one folder at a time")
            datasets[name] = dataset
        return datasets

    def write(self, export: Export) -> None:
        """Write the layout of the published ACWM-Phys release.

        Video is H.264 (CRF 18): visually lossless, not bit-exact. Actions are normalised to [-1, 1]
        by the card's bounds; the last row, which leads to no frame, is zero. The layout cannot
        store states, masks, contacts and factors.
        """
        card = export.card.environment
        category, name = PLACES.get(card.name, (OTHERS, card.name))
        low, high = np.array(card.action.low), np.array(card.action.high)
        folders = {split: folder for folder, split in FOLDERS.items()}
        for split in export.splits:
            folder = inside(export.folder, f"{category}/{name}/{folders[split]}")
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
            torch.save(entries, folder / METADATA)

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """An example dataset that `write` made."""
        return {"root": exported_example(folder, cls())}


def _dataset(folder: Path, follow_links: bool) -> RecordedDataset:
    """The dataset of one environment."""
    places = _splits(folder)
    entries: dict[Split, list[EpisodeMetadata]] = {
        s: read_entries(places[s] / METADATA) for s in places
    }
    name = folder.resolve().name
    meaning = _meaning(_environment_name(name), entries)
    split = next(iter(places))
    first = VideoFrames(places[split] / entries[split][0].video)
    return RecordedDataset(
        meaning.name,
        {s: PublishedRecordings(place, len(entries[s])) for s, place in places.items()},
        {
            "kind": "acwm-phys",
            "name": name,
            "sha256": {split: _sha256(place / METADATA) for split, place in places.items()},
        },
        options={"follow_links": follow_links},
        actions=meaning.actions,
        size=USUAL if _side(first) == (LARGE, LARGE) else None,
        notes=(*meaning.notes, *_notes(places, entries)),
        summary=meaning.summary,
        citation=meaning.citation,
    )


def _side(frames: VideoFrames) -> tuple[int, int] | None:
    """The size of frames; None if they cannot be read, which the import tells."""
    try:
        return frames.size
    except (DataError, OSError):
        return None


@dataclass(frozen=True)
class PublishedRecordings:
    """The episodes in the folder of one split, opened on request."""

    folder: Path
    count: int

    def __len__(self) -> int:
        """The number of episodes."""
        return self.count

    def __getitem__(self, index: int) -> TimedRecording:
        """Open an episode, without decoding its frames."""
        entry = _entries(self.folder / METADATA)[index]
        frames = VideoFrames(self.folder / entry.video)
        name = f"{self.folder.name}/{entry.video}"
        rate = video_index(frames.path).rate
        actions = Samples(entry.actions)
        return TimedRecording(name, {"video": frames}, actions, rate=rate, length=entry.length)


def _folders(root: Path) -> list[Path]:
    """The folders of environments, one or two levels below `root`."""
    for pattern in ("*", "*/*"):
        folders = sorted(folder for folder in root.glob(pattern) if _splits(folder))
        if folders:
            return folders
    raise DataError(
        f"{root} is not in the published layout: there is no {' or '.join(FOLDERS)} with a "
        f"{METADATA}, in it or in CATEGORY/ENVIRONMENT below it"
    )


@functools.lru_cache(maxsize=1)
def _entries(path: Path) -> list[EpisodeMetadata]:
    """Read the metadata once per worker for all recordings of a split."""
    return read_entries(path)


def _splits(folder: Path) -> dict[Split, Path]:
    """The folders of the existing splits."""
    places: dict[Split, Path] = {split: folder / name for name, split in FOLDERS.items()}
    pieces = [p for p in places.values() if not (p / METADATA).exists() and any(p.glob(PARTS))]
    if pieces:
        raise DataError(f"{pieces[0]} has pieces of the metadata ({PARTS}) but no {METADATA}")
    return {split: places[split] for split in places if (places[split] / METADATA).is_file()}


def _environment_name(folder: str) -> str:
    """The environment of a folder of the release, or the folder's name as an identifier."""
    return ENVIRONMENTS.get(folder) or re.sub(r"\W+", "_", folder).strip("_").lower() or "imported"


class _Meaning(NamedTuple):
    """The description of the environment."""

    name: str
    actions: ActionFacts
    summary: str
    citation: str
    notes: tuple[str, ...]


def _meaning(name: str, entries: Mapping[Split, list[EpisodeMetadata]]) -> _Meaning:
    """Take the description from the registered environment if the sizes of its actions match."""
    sizes = Counter(entry.actions.shape[1] for part in entries.values() for entry in part)
    size = sizes.most_common(1)[0][0]  # others are defects of their episodes
    known = next((card for card in _registered(name) if card.action.size == size), None)
    notes = ["Actions are as published, normalised to [-1, 1]: units are lost."]
    if known is None:
        notes.append(
            f"No environment {name} with {size}-D actions is installed: names are action_0, …"
        )
    elif known.name != name:
        notes.append(f"The actions are {size}-D: read as {known.name}, a variant of {name}.")
    actions = ActionFacts(
        known.action.names if known else tuple(f"action_{i}" for i in range(size)),
        kind=known.action.kind if known else None,
        bounds=((-1.0,) * size, (1.0,) * size),
        widened=True,
    )
    return _Meaning(
        known.name if known else name,
        actions,
        known.summary if known else f"{name}, in the layout of ACWM-Phys",
        known.citation if known else CITATION,
        tuple(notes),
    )


def _registered(name: str) -> list[EnvironmentCard]:
    """The cards of an environment and its variants, if they are installed."""
    cards = _card(name)
    return cards + [
        variant for card in cards for other in card.variants for variant in _card(other)
    ]


def _card(name: str) -> list[EnvironmentCard]:
    try:
        card: object = getattr(catalog().component("environment", name).load(), "card", None)
    except AcwmError:
        return []
    return [card] if isinstance(card, EnvironmentCard) else []


def _notes(
    places: Mapping[Split, Path], entries: Mapping[Split, list[EpisodeMetadata]]
) -> list[str]:
    notes: list[str] = []
    for split, place in places.items():
        pieces = len(list(place.glob(PARTS)))
        if pieces:
            notes.append(f"{split}: {pieces} pieces of metadata left aside for the aggregate")
        videos = {path.name for path in files_in(place, [".mp4"])}
        unlisted = videos - {entry.video for entry in entries[split]}
        if unlisted:
            notes.append(f"{split}: {len(unlisted)} videos are not in the metadata, left aside")
    return notes


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
