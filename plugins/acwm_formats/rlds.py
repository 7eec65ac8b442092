"""The format RLDS: episodes as TensorFlow Datasets writes them, e.g. those of Open X-Embodiment."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.episode import Split
from acwm_core.errors import DataError, suggest
from acwm_core.files import check_fetched, parse_json
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, file_stamp, regular_times
from acwm_formats.images import CHANNELS
from acwm_formats.names import exact, word, words
from acwm_formats.rlds_features import FEATURES, Feature, Lists, read_features
from acwm_formats.sources import damage_of, files_in, guarded
from acwm_formats.texts import text_fact, text_note
from acwm_formats.tfrecords import RecordPlace, parse_example, read_record, record_places
from acwm_formats.timeline import ActionFacts, RecordedDataset, Samples, TimedRecording

INFO = "dataset_info.json"

SHARD = re.compile(r"(?P<name>.+)-(?P<split>[^-]+)\.tfrecord-(?P<number>\d{5})-of-(?P<of>\d{5})")

TESTS = ("test", "ind_test", "val", "validation")
"""Splits that become test episodes; all others become training data."""

OBSERVED, ACTION = "steps/observation/", "steps/action"
FLAGS = ("is_first", "is_last", "is_terminal")
REWARD = "steps/reward"


class RLDS(Format):
    """RLDS datasets in TFRecord files; read only, without TensorFlow."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether there is a ``features.json`` with TFRecord files, in the folder or a version."""
        return any(_is_dataset(folder) for folder in _versions(path))

    @guarded
    def read(
        self,
        root: Path,
        *,
        rate: float,
        video: str | None = None,
        actions: str | None = None,
        states: str | None = None,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import an RLDS dataset of TensorFlow Datasets, e.g. of Open X-Embodiment.

        Imports the images, actions and numbers of the observations; instructions, rewards and the
        metadata of episodes are kept as facts. Splits called test or val become test episodes.

        Args:
            root: the folder with features.json, or the one above it.
            rate: Steps per second, which the format does not store.
            video: Names of the images, e.g. image,wrist/rgb; by default all.
            actions: Features that are the actions, joined in this order, e.g. action/world_vector;
                by default all numbers in action.
            states: Names of the observed numbers to keep; by default all but embeddings of text.
            follow_links: Whether links may lead out of the folder.
        """
        folder = _version(Path(root))
        features, shards = read_features(folder), _shards(folder)
        layout = _layout(features, words(video), words(actions), words(states))
        recordings = RLDSRecordings(folder, layout, exact(rate))
        index = _index(folder)
        names = _action_names(layout.actions)
        return RecordedDataset(
            name=word(folder.parent if folder.name[0].isdecimal() else folder),
            splits=recordings,
            tests=_tests(index),
            facts={"kind": "rlds", "name": shards[0].name, "episodes": len(index)},
            options={"rate": rate, "video": video, "actions": actions, "states": states}
            | {"follow_links": follow_links},
            actions=ActionFacts(names, ask=True),
            notes=_notes(folder, features, layout, shards),
            summary=f"The RLDS dataset {shards[0].name}",
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """Two short episodes of frames as plain bytes."""
        from acwm_formats.rlds_example import write_example

        write_example(folder / "noise" / "1.0.0")
        return {"root": folder / "noise", "rate": 10.0}


@dataclass(frozen=True)
class StepFeatures:
    """The features that are read, by what they are.

    Attributes:
        cameras: images by name.
        actions: joined in this order.
        states: observed numbers by name.
        texts: instructions and other texts of steps by name.
        metadata: features of the whole episode by name.
        others: features that are not read.
        flagged: those of `FLAGS` that there are.
    """

    cameras: Mapping[str, Feature]
    actions: tuple[Feature, ...]
    states: Mapping[str, Feature]
    texts: Mapping[str, Feature]
    metadata: Mapping[str, Feature]
    others: tuple[str, ...]
    flagged: tuple[Feature, ...]


def _layout(
    features: Mapping[str, Feature],
    video: tuple[str, ...],
    actions: tuple[str, ...],
    states: tuple[str, ...],
) -> StepFeatures:
    seen = {path.removeprefix(OBSERVED): feature for path, feature in features.items()}
    seen = {name: feature for name, feature in seen.items() if feature.path.startswith(OBSERVED)}
    images = {name: feature for name, feature in seen.items() if _shows(feature)}
    numbers = {n: f for n, f in seen.items() if f.kind == "numbers" and n not in images}
    acting = {p.removeprefix("steps/"): f for p, f in features.items() if f.kind == "numbers"}
    own = [n for n in acting if n == "action" or n.startswith("action/")]
    cameras = {name: images[_known(name, images, "images")] for name in video or images}
    taken = tuple(acting[_known(name, acting, "numbers")] for name in actions or own)
    kept = [n for n in numbers if "embedding" not in n and len(numbers[n].shape) <= 2]
    observed = {n: numbers[_known(n, numbers, "observed numbers")] for n in states or kept}
    if not cameras or not taken:
        missing = "numbers in `action`: give --actions NAME" if cameras else "images to predict"
        raise DataError(f"the steps have {', '.join(seen) or 'no observation'}, and no {missing}")
    texts = {p.rpartition("/")[2]: f for p, f in features.items() if f.kind == "text"}
    texts = {name: feature for name, feature in texts.items() if feature.path.startswith("steps/")}
    metadata = {p: f for p, f in features.items() if not p.startswith("steps/")}
    flagged = tuple(features[f"steps/{n}"] for n in FLAGS if f"steps/{n}" in features)
    used = {
        feature.path for feature in (*cameras.values(), *taken, *observed.values(), *texts.values())
    }
    used |= {feature.path for feature in flagged} | {*metadata, REWARD, "steps/discount"}
    others = tuple(path for path in features if path not in used)
    return StepFeatures(cameras, taken, observed, texts, metadata, others, flagged)


def _known(name: str, features: Mapping[str, Feature], what: str) -> str:
    if name not in features:
        raise DataError(f"the dataset has no {what} {name!r}{suggest(name, features)}")
    return name


def _shows(feature: Feature) -> bool:
    """Whether it is an image, or numbers that look like one."""
    if feature.kind == "image":
        return True
    shape = feature.shape
    return feature.dtype == "uint8" and len(shape) == 3 and shape[2] in CHANNELS


def _action_names(actions: Sequence[Feature]) -> tuple[str, ...]:
    """Names of the dimensions; none if the action is one vector."""
    if len(actions) == 1:
        return ()
    names: list[str] = []
    for feature in actions:
        last, size = feature.path.rpartition("/")[2], int(np.prod(feature.shape))
        names += [last] if size == 1 else [f"{last}_{place}" for place in range(size)]
    return tuple(names) if len({*names}) == len(names) else ()


@dataclass(frozen=True)
class RLDSRecordings:
    """The episodes of a dataset, opened on request: a record each."""

    root: Path
    layout: StepFeatures
    rate: Fraction

    def __len__(self) -> int:
        """The number of episodes."""
        return len(_index(self.root))

    def __getitem__(self, index: int) -> TimedRecording:
        """Open an episode, without decoding its frames.

        Raises:
            DataError: its record is damaged, or is not one whole episode.
        """
        episode, layout = _index(self.root)[index], self.layout
        with damage_of(f"{episode.title} of {self.root}"):
            lists = _lists(episode.path, episode.place, file_stamp(episode.path))
            count = _steps(layout, lists)
            notes = _checked_flags(layout, lists, count)
            actions = [f.values(lists, count).reshape(count, -1) for f in layout.actions]
            rows = np.concatenate([columns.astype(np.float64) for columns in actions], 1)
            states = {n: Samples(f.values(lists, count)) for n, f in layout.states.items()}
            cameras = {name: self._frames(name, episode, count) for name in layout.cameras}
            facts = {"split": episode.split, **_facts(layout, lists, count)}
        return TimedRecording(
            episode.title, cameras, Samples(rows), states, self.rate, facts=facts, notes=notes
        )

    def _frames(self, name: str, episode: EpisodeRecord, count: int) -> ImageFrames:
        images = StepImages(episode, self.layout.cameras[name], count)
        stamp = f"{episode.place} {name} {file_stamp(episode.path)}"
        return ImageFrames(images, regular_times(count, self.rate), stamp=stamp)


class Shard(NamedTuple):
    """One of the files of a split."""

    path: Path
    name: str
    split: str
    number: int
    of: int


class EpisodeRecord(NamedTuple):
    """Where an episode lies."""

    split: str
    number: int
    path: Path
    place: RecordPlace

    @property
    def title(self) -> str:
        """What people know it by."""
        return f"{self.split} episode {self.number}"


@dataclass(frozen=True)
class StepImages:
    """The images of an episode, read from its record when they are asked for."""

    episode: EpisodeRecord
    feature: Feature
    count: int

    def __len__(self) -> int:
        """The number of steps."""
        return self.count

    def __getitem__(self, index: int) -> bytes | NDArray[Any]:
        """The picture, as bytes of a file or as an array."""
        path, place = self.episode.path, self.episode.place
        lists = _lists(path, place, file_stamp(path))
        if self.feature.kind == "numbers":
            return _pixels(self.feature, path, place, file_stamp(path))[index]
        return lists[self.feature.path][index]


@functools.lru_cache(maxsize=1)
def _lists(path: Path, place: RecordPlace, _: str) -> Lists:
    return parse_example(read_record(path, place))


@functools.lru_cache(maxsize=1)
def _pixels(feature: Feature, path: Path, place: RecordPlace, stamp: str) -> NDArray[Any]:
    lists = _lists(path, place, stamp)
    values = lists.get(feature.path, ())
    count = len(values) if isinstance(values, list) else len(values) // int(np.prod(feature.shape))
    return feature.values(lists, count)


def _steps(layout: StepFeatures, lists: Lists) -> int:
    """The number of steps of an episode, by its images.

    Raises:
        DataError: cameras have different numbers of images, or none.
    """
    counts: dict[str, int] = {}
    for name, feature in layout.cameras.items():
        values = lists.get(feature.path, ())
        plain = isinstance(values, np.ndarray)
        counts[name] = len(values) // max(1, int(np.prod(feature.shape))) if plain else len(values)
    if len({*counts.values()}) > 1 or not all(counts.values()):
        numbers = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise DataError(f"its cameras have {numbers}, not an image for each step")
    return next(iter(counts.values()))


def _checked_flags(layout: StepFeatures, lists: Lists, count: int) -> tuple[str, ...]:
    """What the marks of first and last steps say.

    Raises:
        DataError: another episode begins within it.
    """
    marked = {f.path.rpartition("/")[2]: f.values(lists, count) for f in layout.flagged}
    later = np.flatnonzero(marked.get("is_first", np.zeros(1))[1:]) + 1
    early = np.flatnonzero(marked.get("is_last", np.zeros(1))[:-1])
    if len(later) or len(early):
        step = int(later[0] if len(later) else early[0] + 1)
        raise DataError(f"another episode begins within it, in step {step} (counted from 0)")
    whole = "is_last" not in marked or marked["is_last"][-1]
    return () if whole else ("its last step is not marked is_last, so it may have been cut off",)


def _facts(layout: StepFeatures, lists: Lists, count: int) -> dict[str, Any]:
    """What else is known of an episode, for JSON."""
    facts: dict[str, Any] = {}
    for name, feature in (*layout.metadata.items(), *layout.texts.items()):
        if feature.path not in lists:
            continue
        if feature.kind == "text":
            if (text := text_fact(feature.texts(lists))) is not None:
                facts[name] = text
        elif feature.kind == "numbers" and int(np.prod(feature.shape)) <= 64:
            facts[name] = feature.values(lists, 1)[0].tolist()
    rewards = lists.get(REWARD)
    if isinstance(rewards, np.ndarray) and len(rewards) == count:
        facts["rewards"] = rewards.tolist()
    return facts


def _is_dataset(folder: Path) -> bool:
    return (folder / FEATURES).is_file() and next(folder.glob("*.tfrecord-*"), None) is not None


def _versions(path: Path) -> list[Path]:
    """The folder itself, and those of versions in it."""
    inside = [folder for folder in path.glob("[0-9]*") if folder.is_dir()] if path.is_dir() else []
    return [path, *sorted(inside)]


def _version(root: Path) -> Path:
    folders = [folder for folder in _versions(root) if _is_dataset(folder)]
    if len(folders) == 1:
        return folders[0]
    if not folders:
        raise DataError(f"{root} has no {FEATURES} with TFRecord files")
    raise DataError(f"{root} has several versions: name {' or '.join(map(str, folders))}")


def _shards(folder: Path) -> list[Shard]:
    """The files of all splits, in their order.

    Raises:
        DataError: there are none, they are of several datasets, or of another kind.
    """
    shards: list[Shard] = []
    for path in files_in(folder, [""]):
        if match := SHARD.fullmatch(path.name):
            numbers = int(match["number"]), int(match["of"])
            shards.append(Shard(path, match["name"], match["split"], *numbers))
    if not shards or len({shard.name for shard in shards}) > 1:
        raise DataError(f"{folder} has no TFRecord files of one dataset, NAME-SPLIT.tfrecord-…")
    return shards


def _claimed(folder: Path) -> dict[str, list[int]]:
    """How many episodes each shard of a split has, where ``dataset_info.json`` says it.

    Raises:
        DataError: it cannot be read, or the files are of another kind.
    """
    path = folder / INFO
    if not path.is_file():
        return {}
    check_fetched(path)
    try:
        info = dict(parse_json(path.read_bytes()))
        splits = {str(s["name"]): [*map(int, s.get("shardLengths", []))] for s in info["splits"]}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(f"{path} cannot be read ({error or type(error).__name__})") from error
    if info.get("fileFormat", "tfrecord") != "tfrecord":
        raise DataError(f"{folder} holds {info['fileFormat']} files: only tfrecord is read")
    return splits


def _index(folder: Path) -> tuple[EpisodeRecord, ...]:
    stamps = [file_stamp(shard.path) for shard in _shards(folder)]
    return _index_of(folder, " ".join(stamps))


@functools.lru_cache(maxsize=2)
def _index_of(folder: Path, _: str) -> tuple[EpisodeRecord, ...]:
    """Where all episodes lie, training episodes first.

    Raises:
        DataError: a shard is damaged, or holds another number of episodes than it should.
    """
    claimed, episodes = _claimed(folder), dict[str, list[EpisodeRecord]]()
    for shard in _shards(folder):
        places, said = record_places(shard.path), claimed.get(shard.split, [])
        wanted = said[shard.number] if len(said) == shard.of and shard.number < shard.of else None
        if wanted is not None and wanted != len(places):
            raise DataError(
                f"{shard.path} has {len(places)} episodes, but {INFO} says {wanted}: copy it again"
            )
        inside = episodes.setdefault(shard.split, [])
        inside += [
            EpisodeRecord(shard.split, len(inside) + k, shard.path, place)
            for k, place in enumerate(places)
        ]
    order = sorted(episodes, key=lambda split: (split in TESTS, split != "train", split))
    return tuple(episode for split in order for episode in episodes[split])


def _tests(index: Iterable[EpisodeRecord]) -> Mapping[Split, Sequence[int]] | None:
    """The test episodes, if the splits say which."""
    places = [place for place, episode in enumerate(index) if episode.split in TESTS]
    return {"ind_test": places} if places else None


def _notes(
    folder: Path, features: Mapping[str, Feature], layout: StepFeatures, shards: Sequence[Shard]
) -> tuple[str, ...]:
    """What people should know about how the dataset was read."""
    notes = [f"Features that were left out: {', '.join(layout.others)}."] if layout.others else []
    for split in dict.fromkeys(shard.split for shard in shards):
        here, of = [s for s in shards if s.split == split], max(s.of for s in shards)
        of = here[0].of
        if len(here) < of:
            notes.append(f"{of - len(here)} of {of} files of the split {split} are not there.")
    absent = [split for split in _claimed(folder) if split not in {s.split for s in shards}]
    if absent:
        notes.append(f"Splits that are not there: {', '.join(absent)}.")
    return (*notes, *text_note(layout.texts))
