"""The format HDF5: read in several layouts, written as one file per split with bit-exact data."""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import h5py

from acwm_core.data.card import UNREADABLE, DatasetCard
from acwm_core.env.card import EnvironmentCard
from acwm_core.env.episode import SPLITS, Episode, Split
from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_formats.array_store import ArrayLayout, StoredEpisode, StoredEpisodes
from acwm_formats.channels import Channels
from acwm_formats.episode_bounds import Bounds
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format
from acwm_formats.frames import stack_note
from acwm_formats.hdf5_layouts import (
    array,
    bounds_in,
    episode_groups,
    files_of,
    identity,
    layout_of,
    open_hdf5,
    partial_groups,
    values_of,
)
from acwm_formats.hdf5_store import HDF5Group
from acwm_formats.names import (
    exact,
    is_action,
    natural,
    pair,
    typed,
    unread_note,
    word,
    words,
)
from acwm_formats.sources import guarded
from acwm_formats.texts import text_note
from acwm_formats.timeline import (
    ActionFacts,
    RecordedDataset,
    Recordings,
    TimedRecording,
    first_sound,
)

Identity = tuple[str, int]

COMPRESSION: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


class HDF5(Format):
    """HDF5: robomimic, LIBERO, ACT/ALOHA, acwm's own and others are read; acwm's own is written."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is or holds HDF5 files, in a layout that is known."""
        files = files_of(path)
        if not files:
            return False
        with open_hdf5(first_sound(files, _opens(None)), None) as file:  # `read` refuses links
            return layout_of(file) is not None

    @guarded
    def read(
        self,
        root: Path,
        *,
        video: str | None = None,
        actions: str | None = None,
        states: str | None = None,
        rate: float | None = None,
        pixel_range: tuple[int, ...] | None = None,
        channels: Channels | None = None,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import an HDF5 file, or a folder of them.

        Layouts of robomimic, LIBERO, ACT/ALOHA, stable-worldmodel and acwm are known. For any
        other, name the frames and actions in the group of an episode, e.g. --video obs/front
        --actions actions; every group that has both is an episode, or several in a row where an
        array such as ep_len or episode_index says so.

        Args:
            root: the file or folder.
            video: Path of the frames in an episode's group; several with a comma between.
            actions: Path of the actions in an episode's group.
            states: Paths of the states to keep, with commas between.
            rate: Frames per second, if the files do not state them.
            pixel_range: Values that are black and white, e.g. 0,1 or 0,65535.
            channels: What four channels are (rgba), or which of stacked grey frames is the newest.
            follow_links: Whether links may lead out of the folder, or of the only file.
        """
        root = Path(root)
        files = files_of(root)
        if not files:
            raise DataError(f"{root} is not an HDF5 file and contains none")
        within = None if follow_links else root
        first = first_sound(files, _opens(within))
        layout = _layout(first, within, video, actions, states)
        if rate is None and layout.rate is None:
            raise DataError(f"{first} does not state its frame rate: give --rate")
        stated = exact(rate) if rate else cast(Fraction, layout.rate)
        reader = functools.partial(
            StoredEpisodes,
            layout=layout,
            rate=stated,
            pixel_range=pair(pixel_range),
            channels=channels,
        )
        options = {"video": video, "actions": actions, "states": states, "rate": rate}
        options |= {"pixel_range": typed(pixel_range), "channels": channels}
        options["follow_links"] = follow_links
        card = _card(first, within) if layout.name == "acwm" else None
        splits = _splits(files, within, layout, reader)
        return RecordedDataset(
            name=card.name if card else word(root),
            splits=splits,
            facts={"kind": "hdf5", "name": root.resolve().name, "layout": layout.name}
            | {"bytes": sum(path.stat().st_size for path in files), "files": len(files)},
            options=options,
            actions=_action(card, layout),
            state=card.state if card and states is None else None,
            instances=_instances(card),
            notes=_notes(root, files, within, layout, splits, stated=rate is not None),
            summary=card.summary if card else f"Recorded in the layout of {layout.name}",
        )

    def write(self, export: Export) -> None:
        """Write HDF5: one file per split, with bit-exact data and the ground truth.

        Each file holds one group per episode, such as ``episode_000012``, with

        * ``video``, uint8 ``[T, H, W, 3]``, and ``masks``, uint8 ``[T, H, W]``, one chunk per
          frame;
        * ``actions``, float32 ``[T, A]``, raw units; row i leads from frame i to i + 1, the last
          row is 0;
        * ``states/NAME``, ``[T, …]``, and ``contacts``, int32 rows (frame, id, id);
        * attributes ``spec``, ``factors``, ``facts`` (JSON) and ``ood_label`` (text, empty if there
          is none).

        The attributes of the file are ``format`` ("acwm"), ``card`` (the dataset's card as JSON)
        and ``episodes`` (their number).
        """
        for split, dataset in export.splits.items():
            with _PatientFile(export.folder / f"{split}.hdf5") as opened:
                with h5py.File(opened, "w") as file:
                    file.attrs["format"] = "acwm"
                    file.attrs["card"] = json.dumps(export.card.to_dict())
                    file.attrs["episodes"] = len(dataset)
                    for index, episode in enumerate(export.episodes(split)):
                        group = file.create_group(f"episode_{episode.spec.index:06d}")
                        _write(group, episode)
                        group.attrs["facts"] = json.dumps(dataset.about(index)["facts"])
                        opened.check()
                opened.check()

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """An example that `write` made."""
        return {"root": exported_example(folder, cls())}


def _layout(
    path: Path,
    within: Path | None,
    video: str | None,
    actions: str | None,
    states: str | None,
) -> ArrayLayout:
    """The layout of a file, with what the user says in the place of what is known."""
    with open_hdf5(path, within) as file:
        known = layout_of(file)
    if known is None and (video is None or actions is None):
        raise DataError(
            f"{path} is in no known layout: give --video and --actions, the paths of "
            "frames and actions in the group of an episode"
        )
    custom = ArrayLayout("its owner", _paths(video), (actions or "").strip("/"), _paths(states))
    if known is None:
        return custom
    kind = known.kind if custom.actions in ("", known.actions) else None
    return replace(
        known,
        kind="absolute" if kind is None and "abs" in custom.actions.split("_") else kind,
        cameras=custom.cameras or known.cameras,
        actions=custom.actions or known.actions,
        states=known.states if states is None else custom.states,
    )


def _paths(text: str | None) -> dict[str, str]:
    """Paths with a comma between, by a name for each."""
    return {path.strip("/").replace("/", "."): path.strip("/") for path in words(text)}


def _splits(
    files: Sequence[Path],
    within: Path | None,
    layout: ArrayLayout,
    reader: Callable[[dict[int, StoredEpisode]], Recordings],
) -> Recordings | dict[Split, Recordings]:
    """The episodes by split, if the files say it, and else all."""
    by_split: dict[Split | None, list[StoredEpisode]] = {}
    damaged: list[StoredEpisode] = []
    known, own_files = set[Identity](), {os.path.realpath(path) for path in files}
    for path in files:
        try:
            groups, tests = _contents(path, within, layout, known, own_files)
        except DataError as error:
            damaged.append(StoredEpisode(HDF5Group(path, "/", within), problem=str(error)))
            continue
        own = path.stem if layout.name == "acwm" and path.stem in SPLITS else None
        for name, episodes in groups.items():
            of_tests = tests and tests.get(name.split("/")[-1], "train")
            by_split.setdefault(cast(Split | None, own or of_tests), []).extend(episodes)
    if damaged and by_split:
        by_split.setdefault(None if None in by_split else "train", []).extend(damaged)
    if damaged and not by_split:
        raise DataError(damaged[0].problem)
    if not by_split:
        what = " and ".join((layout.actions, *layout.cameras.values()))
        raise DataError(f"{files[0]} has no group with {what}")
    if None in by_split:
        return reader(dict(enumerate(itertools.chain(*by_split.values()))))
    return {
        split: reader(dict(enumerate(episodes))) for split, episodes in by_split.items() if split
    }


def _contents(
    path: Path,
    within: Path | None,
    layout: ArrayLayout,
    known: set[Identity],
    others: set[str],
) -> tuple[dict[str, list[StoredEpisode]], dict[str, Split] | None]:
    """The episodes in a file by their group, and the groups that it sets aside for tests.

    Groups to which links lead are left out if they lie in one of the `others`, which are read, too,
    or are `known`; those that are found are added.
    """
    with open_hdf5(path, within) as file:
        names = [
            name
            for name in episode_groups(file, layout)
            if (own := identity(file[name])) not in known
            and (own[0] == os.path.realpath(path) or own[0] not in others)
        ]
        known |= {identity(file[name]) for name in names}
        groups: dict[str, list[StoredEpisode]] = {}
        for name in names:
            alone = len(names) == 1 and not layout.is_robosuite  # whose flags mean success
            arrays = HDF5Group(path, name, within)
            groups[name] = [*_episodes(arrays, file[name], layout, alone=alone)]
        if layout.is_robosuite and names:  # opening one will tell what it lacks
            for name in partial_groups(file, layout):
                groups[name] = [StoredEpisode(HDF5Group(path, name, within))]
        return {name: groups[name] for name in sorted(groups, key=natural)}, _tests(file)


def _episodes(
    arrays: HDF5Group, group: Any, layout: ArrayLayout, *, alone: bool
) -> Iterator[StoredEpisode]:
    """The episodes in a group: one, or several in a row."""
    try:
        bounds = None if layout.name == "acwm" else _bounds(group, layout, alone=alone)
    except DataError as error:
        yield StoredEpisode(arrays, problem=str(error))
        return
    if bounds is None:
        yield StoredEpisode(arrays)
    for number, (start, stop) in enumerate(bounds or ()):
        yield StoredEpisode(arrays, number, len(bounds or ()), start, stop)


def _bounds(group: Any, layout: ArrayLayout, *, alone: bool) -> Bounds | None:
    """The episodes in the rows of a group; None if they are one."""
    count = len(array(group, layout.actions))
    bounds = bounds_in(group, count, alone=alone)
    for where in (*layout.cameras.values(), *layout.states.values()) if bounds else ():
        if (other := len(array(group, where))) != count:
            raise DataError(f"{where} has {other} rows, but the actions have {count}")
    return bounds


def _notes(
    root: Path,
    files: Sequence[Path],
    within: Path | None,
    layout: ArrayLayout,
    splits: Recordings | Mapping[Split, Recordings],
    *,
    stated: bool,
) -> tuple[str, ...]:
    """What people should know about how the files were read."""
    notes = [layout.note] if layout.note and not stated else []
    notes += unread_note(root, files)
    for path in () if layout.name == "acwm" or layout.is_robosuite else files:
        with contextlib.suppress(DataError), open_hdf5(path, within) as file:
            if lacking := partial_groups(file, layout):
                what = " and ".join((layout.actions, *layout.cameras.values()))
                notes.append(f"Groups of {path.name} without {what}: {', '.join(lacking[:5])}.")
    with open_hdf5(first_sound(files, _opens(within)), within) as file:
        if names := episode_groups(file, layout):
            group = file[names[0]]
            others = [n for n in group if is_action(n) and n != layout.actions]
            used = {*layout.states.values(), *layout.cameras.values()}
            if left := sorted({*others} - used):
                notes.append(
                    f"Actions are {layout.actions}; left out: {', '.join(left)} (--actions NAME)."
                )
    first = next(iter(splits.values())) if isinstance(splits, Mapping) else splits
    with contextlib.suppress(DataError, OSError, LookupError):
        recording = cast(TimedRecording, first[0])
        notes += stack_note(recording.cameras.values())
        notes += text_note(recording.facts) if layout.name != "acwm" else []
    return tuple(notes)


def _opens(within: Path | None) -> Callable[[Path], None]:
    """Opens a file and closes it, to find out whether it can be read."""
    return lambda path: open_hdf5(path, within).close()


def _tests(file: Any) -> dict[str, Split] | None:
    """The demonstrations that robomimic sets aside for validation."""
    mask = file.get("mask/valid")
    if not isinstance(mask, h5py.Dataset):
        return None
    return {bytes(name).decode(): "ind_test" for name in values_of(mask)}


def _action(card: EnvironmentCard | None, layout: ArrayLayout) -> ActionFacts:
    if card is None:
        return ActionFacts(kind=layout.kind, held=layout.held, ask=layout.is_robosuite)
    spec = card.action
    return ActionFacts(spec.names, spec.units, spec.kind, (spec.low, spec.high))


def _instances(card: EnvironmentCard | None) -> tuple[str, ...]:
    """The names of the ids in masks; none if all are zero."""
    return card.instances if card and len(card.instances) > 1 else ()


def _card(path: Path, within: Path | None) -> EnvironmentCard:
    """The card in a file that acwm wrote."""
    with open_hdf5(path, within) as file:
        try:
            return DatasetCard.from_dict(parse_json(file.attrs["card"])).environment
        except UNREADABLE as error:
            raise DataError(f"{path} has no card that can be read ({error})") from error


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
