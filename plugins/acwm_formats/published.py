"""The published ACWM-Phys release, or anything in its layout: import and export."""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.video import write_mp4
from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.env.episode import Split
from acwm_core.errors import AcwmError, DataError
from acwm_core.plugins import catalog
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format, import_command
from acwm_formats.published_layout import (
    CITATION,
    ENVIRONMENTS,
    FOLDERS,
    METADATA,
    PARTS,
    PLACES,
    Entry,
    read_entries,
)
from acwm_formats.recordings import RecordedDataset, Recording, recorded_card
from acwm_formats.video import shrunk, target_size, video_facts, video_frames

LARGE = 1024  # square videos of this side are averaged down to `USUAL` by default
USUAL = 240
FPS = 10  # for videos without a frame rate
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

    def read(
        self,
        root: Path,
        *,
        size: int | tuple[int, int] | None = None,
        environment: str | None = None,
    ) -> RecordedDataset | dict[str, RecordedDataset]:
        """Import the published ACWM-Phys release.

        ROOT is the folder of one environment, which becomes the dataset OUT, or a folder of several
        environments, each of which becomes a dataset OUT/NAME. Videos of 1024×1024 become 240×240
        unless --size says otherwise.

        Args:
            root: the folder of one environment, with some of ``ind_train``, ``ind_test`` and
                ``ood_test`` in it, or a folder one or two levels above.
            size: Frame size, 64 or HEIGHTxWIDTH; by default that of the videos.
            environment: Name of the environment.
        """
        root = Path(root)
        if _splits(root):
            return _dataset(root, size, environment)
        folders = _folders(root)
        if environment and len(folders) > 1:
            raise DataError(
                f"{root} holds {len(folders)} environments: give --environment for one "
                "folder at a time"
            )
        found: dict[str, RecordedDataset] = {}
        for folder in folders:
            dataset = _dataset(folder, size, environment)
            name = dataset.environment.name
            if name in found:
                raise DataError(f"{folder} is a second {name}: import one folder at a time")
            found[name] = dataset
        return found

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
            torch.save(entries, folder / METADATA)

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """An example dataset that `write` made."""
        return {"root": exported_example(folder, cls())}


def _dataset(
    folder: Path, size: int | tuple[int, int] | None, environment: str | None
) -> RecordedDataset:
    """The dataset of one environment."""
    places = _splits(folder)
    entries: dict[Split, list[Entry]] = {s: read_entries(places[s] / METADATA) for s in places}
    split = next(iter(places))
    video = video_facts(places[split] / entries[split][0].video)
    if size is None and video.size == (LARGE, LARGE):
        size = USUAL
    name = folder.resolve().name
    meaning = _meaning(environment or _environment_name(name), entries)
    card = recorded_card(
        meaning.name,
        meaning.action,
        frame_size=target_size(video.size, size),
        fps=round(video.fps) or FPS,
        horizon=max(_nominal(entry) for each in entries.values() for entry in each),
        summary=meaning.summary,
        citation=meaning.citation,
    )
    options = {"environment": environment, "size": card.frame_size}
    facts = {
        "kind": "acwm-phys",
        "name": name,
        "command": import_command("acwm-phys", name, **options),
        "sha256": {split: _sha256(place / METADATA) for split, place in places.items()},
    }
    return RecordedDataset(
        card,
        {s: PublishedRecordings(place, len(entries[s]), card) for s, place in places.items()},
        facts,
        notes=(*meaning.notes, *_notes(places, entries)),
        nominal={s: [entry.length for entry in entries[s]] for s in places},
    )


@dataclass(frozen=True)
class PublishedRecordings:
    """The episodes in the folder of one split, read on demand."""

    folder: Path
    count: int
    card: EnvironmentCard

    def __len__(self) -> int:
        """The number of episodes."""
        return self.count

    def __getitem__(self, index: int) -> Recording:
        """Decode an episode; its length is the shortest of video, actions and nominal length."""
        entry = _entries(self.folder / METADATA)[index]
        nominal = itertools.islice(video_frames(self.folder / entry.video), _nominal(entry))
        video = shrunk(nominal, self.card.frame_size)
        return Recording(video, entry.actions[: len(video)])


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


def _nominal(entry: Entry) -> int:
    return min(entry.length, len(entry.actions))


@functools.lru_cache(maxsize=1)
def _entries(path: Path) -> list[Entry]:
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
    action: ActionSpec
    summary: str
    citation: str
    notes: tuple[str, ...]


def _meaning(name: str, entries: Mapping[Split, list[Entry]]) -> _Meaning:
    """Take the description from the registered environment if the sizes of its actions match."""
    actions = [entry.actions for each in entries.values() for entry in each]
    sizes = {rows.shape[1] for rows in actions}
    if len(sizes) != 1:
        raise DataError(f"the episodes have actions of different sizes: {sorted(sizes)}")
    (size,) = sizes
    known = next((card for card in _registered(name) if card.action.size == size), None)
    notes = ["Actions are as published, normalised to [-1, 1]: units are lost."]
    if known is None:
        notes.append(
            f"No environment {name} with {size}-D actions is installed: names are action_0, …"
        )
    elif known.name != name:
        notes.append(f"The actions are {size}-D: read as {known.name}, a variant of {name}.")
    low, high = _bounds(actions)
    if low.min() < -1 or high.max() > 1:
        notes.append("Some actions exceed [-1, 1]; the bounds are those of the data.")
    names = known.action.names if known else tuple(f"action_{i}" for i in range(size))
    kind: Literal["absolute", "delta", "torque"] = known.action.kind if known else "absolute"
    action = ActionSpec(names, ("",) * size, tuple(low.tolist()), tuple(high.tolist()), kind)
    return _Meaning(
        known.name if known else name,
        action,
        known.summary if known else f"{name}, in the layout of ACWM-Phys",
        known.citation if known else CITATION,
        tuple(notes),
    )


def _bounds(actions: list[NDArray[np.float32]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows = [each for each in actions if len(each)]
    if not rows:
        raise DataError("no episode has an action")
    low = np.min([each.min(0) for each in rows], axis=0).astype(np.float64)
    high = np.max([each.max(0) for each in rows], axis=0).astype(np.float64)
    return np.minimum(low, -1), np.maximum(high, 1)


def _registered(name: str) -> list[EnvironmentCard]:
    """The cards of an environment and its variants, if they are installed."""
    cards = _card(name)
    return cards + [card for found in cards for other in found.variants for card in _card(other)]


def _card(name: str) -> list[EnvironmentCard]:
    try:
        card: object = getattr(catalog().component("environment", name).load(), "card", None)
    except AcwmError:
        return []
    return [card] if isinstance(card, EnvironmentCard) else []


def _notes(places: Mapping[Split, Path], entries: Mapping[Split, list[Entry]]) -> list[str]:
    notes: list[str] = []
    for split, place in places.items():
        pieces = len(list(place.glob(PARTS)))
        if pieces:
            notes.append(f"{split}: {pieces} pieces of metadata left aside for the aggregate")
        unlisted = {path.name for path in place.glob("*.mp4")} - {e.video for e in entries[split]}
        if unlisted:
            notes.append(f"{split}: {len(unlisted)} videos are not in the metadata, left aside")
    return notes


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
