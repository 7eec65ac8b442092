"""Verify a dataset against its card: checksums, contents, and replays in the simulator."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.data.card import MANIFEST, DatasetCard
from acwm_core.data.dataset import Manifest, action_statistics
from acwm_core.data.remote import fetch_shard, origin
from acwm_core.data.shards import MEMBERS, ShardRecord, file_sha256, open_shard, shard_name
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.card import check_episode
from acwm_core.env.episode import Episode, Split
from acwm_core.errors import AcwmError, DataError, expect
from acwm_core.files import check_fetched


@dataclass(frozen=True)
class CheckedItem:
    """The result of one check.

    Attributes:
        what: what was checked, e.g. ``"train/shard-00003.tar"`` or ``"replay of train 7"``.
        problem: one phrase if something is wrong, else None.
        note: a remark for the reader, e.g. why an episode could not be replayed.
    """

    what: str
    problem: str | None = None
    note: str = ""

    def __str__(self) -> str:
        """One line for a terminal."""
        if self.problem:
            return f"FAIL  {self.what}: {self.problem}"
        return f"ok    {self.what}" + (f" ({self.note})" if self.note else "")


ROUNDING = 0.01
"""Mean difference of pixels, of 255 levels, that is rounding, and share of pixels of masks."""


def check_dataset(path: str | Path, *, replays: int = 2) -> Iterator[CheckedItem]:
    """Check every shard of the data folder `path`, and simulate some of its episodes again.

    Recorded episodes are checked but not simulated.

    For each shard this checks the checksum and the names of the members, and for each episode the
    spec, decoding, shapes, types and ranges. Damaged or malicious files do not end the check.
    Nothing in the files is executed, and nothing is written.

    Args:
        replays: how many episodes of each split to simulate again from their specs and actions,
            spread evenly; the results must be identical, up to rounding.

    Raises:
        DataError: there is no dataset, or its card cannot be read.
    """
    path = Path(path)
    card = DatasetCard.read(path)
    for split in card.splits:
        yield _checked(f"{split}/{MANIFEST}", _check_manifest, path / split, card, split)
        sound: list[ShardRecord] = []
        for record in _records(path / split, card.splits[split]):
            shard = path / split / record.shard
            checked = _checked(f"{split}/{record.shard}", _check_shard, shard, record, card, split)
            if checked.problem is None:
                sound.append(record)
            yield checked
        yield from _replays(path / split, card, split, sound, replays)


def _checked(what: str, look: Callable[..., None], *at: Any) -> CheckedItem:
    try:
        look(*at)
    except AcwmError as error:
        return CheckedItem(what, str(error))
    except OSError as error:
        return CheckedItem(what, f"it cannot be read ({error.strerror})")
    return CheckedItem(what)


def _records(folder: Path, episodes: int) -> list[ShardRecord]:
    """The shards of a split, or none if its manifest is unreadable, which another item reports."""
    try:
        return Manifest(folder, episodes).ordered()
    except (DataError, OSError):
        return []


def _check_manifest(folder: Path, card: DatasetCard, split: Split) -> None:
    """Check that all shards are recorded, without gaps, and that there are no other files."""
    expect(folder.is_dir(), "the folder of the split is missing")
    wanted = card.splits[split]
    manifest = Manifest(folder, wanted)
    records = manifest.ordered()
    first = 0
    for number, record in enumerate(records):
        expect(record.shard == shard_name(number), f"{shard_name(number)} is not recorded")
        expect(record.first == first, f"{record.shard} begins at episode {record.first}")
        first += record.episodes
    again = "run the command that made the dataset again to add the others"
    expect(first == wanted, f"{first} of {wanted} episodes are recorded: {again}")
    sums: dict[str, str] = {**card.checksums}
    same = sums.get(split, manifest.checksum()) == manifest.checksum()
    expect(same, "the checksums are not those that the card records")
    said, actual = card.actions.get(split), action_statistics(records)
    same = said is None or _close(said, actual)
    expect(same, "the actions' statistics are not those that the card records")
    known = {record.shard for record in records} | {MANIFEST}
    others = sorted({file.name for file in folder.iterdir() if file.name[0] != "."} - known)
    expect(not others, f"{others[0] if others else ''} does not belong to the dataset")


def _check_shard(path: Path, record: ShardRecord, card: DatasetCard, split: Split) -> None:
    url = origin(path.parents[1])
    if url and not path.exists():
        fetch_shard(f"{url}/{split}/{path.name}", path, record.sha256)
    expect(path.is_file(), "the file is missing")
    check_fetched(path)
    expect(path.stat().st_size == record.size, f"the file does not have {record.size} bytes")
    same = file_sha256(path) == record.sha256
    expect(same, "the checksum of the file differs from the recorded one")
    reader = open_shard(path)
    numbers = range(record.first, record.first + record.episodes)
    wanted = [f"{split}-{index:06d}.{name}" for index in numbers for name in MEMBERS]
    for name, expected in itertools.zip_longest(reader.names, wanted):
        expect(name == expected, f"it holds {name!r} where {expected!r} must be")
    for position, index in enumerate(numbers):
        about = reader.about(position)
        same = about["spec"] == json.loads(json.dumps(card.spec(split, index).to_dict()))
        expect(same, f"episode {index} has another spec than the card")
        episode = reader.episode(position, card.environment.frame_size)
        frames, said = len(episode.video), record.lengths[position]
        expect(frames == said, f"episode {index} has {frames} frames, the manifest says {said}")
        try:
            check_episode(episode, card.environment)
        except DataError as error:
            raise DataError(f"episode {index}: {error}") from None
    sums = asdict(ShardRecord.of_file(path, record.first).actions)
    expect(_close(asdict(record.actions), sums), "the manifest has other sums of its actions")


def _close(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether sums or statistics are equal up to rounding."""
    same = one.keys() == other.keys()
    return same and all(np.allclose(one[name], other[name], rtol=1e-6) for name in one)


def _replays(
    folder: Path, card: DatasetCard, split: Split, records: list[ShardRecord], count: int
) -> Iterator[CheckedItem]:
    places = [(record, position) for record in records for position in range(record.episodes)]
    chosen = np.linspace(0, len(places) - 1, min(count, len(places))).round().astype(int)
    if not len(chosen):
        return
    if card.source:
        yield CheckedItem(f"replay of {split}", note="not tried: recorded, not simulated")
        return
    try:
        environment = make_environment(card.environment.name, card.options)
    except AcwmError as error:
        yield CheckedItem(f"replay of {split}", note=f"not tried: {error}")
        return
    for place in chosen:
        record, position = places[int(place)]
        size = card.environment.frame_size
        stored = open_shard(folder / record.shard).episode(position, size)
        what = f"replay of {split} {record.first + position}"
        try:
            again = simulate(environment, stored.spec, stored.actions)
        except AcwmError as error:
            yield CheckedItem(what, str(error))
            continue
        problem, note = _replay_problem(stored, again), ""
        if problem and _differs_by_rounding(stored, again):
            problem, note = None, "equal up to rounding, as on another kind of processor"
        yield CheckedItem(what, problem, note)
    environment.close()


def _differs_by_rounding(stored: Episode, again: Episode) -> bool:
    """Whether episodes differ by as little as kinds of processors do; `data.md` says how much."""
    if stored.video.shape != again.video.shape or stored.states.keys() != again.states.keys():
        return False
    off = np.abs(stored.video.astype(np.int16) - again.video)
    return (
        float(off.mean()) < ROUNDING
        and float((stored.masks != again.masks).mean()) < ROUNDING
        and np.array_equal(stored.contacts, again.contacts)
        and all(
            np.allclose(values, again.states[name], rtol=1e-4, atol=1e-6)
            for name, values in stored.states.items()
        )
    )


def _replay_problem(stored: Episode, again: Episode) -> str | None:
    names = ("video", "masks", "contacts")
    arrays = {name: (getattr(stored, name), getattr(again, name)) for name in names}
    for name, values in stored.states.items():
        arrays[f"state {name}"] = values, again.states.get(name)
    other = [name for name, pair in arrays.items() if not np.array_equal(*pair)]
    if not other:
        return None
    return (
        f"simulated again, the episode differs in {' and '.join(other[:2])}: the dataset was "
        "made with "
        "another version of the simulator"
    )
