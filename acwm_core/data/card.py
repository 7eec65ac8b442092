"""The dataset card: how a dataset was made, and what training reads from it."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import platform
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import yaml

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import SPLITS, EpisodeSpec, FactorSetting, Split
from acwm_core.errors import DataError
from acwm_core.files import check_fetched, check_inside, parse_yaml, typed, written_whole
from acwm_core.recipe.recipe import flat_items

CARD, MANIFEST = "card.yaml", "manifest.jsonl"
"""The files of a data folder, and of each split in it."""

OWN = (CARD, "README.md", f"*/{MANIFEST}", "*/*.tar", "latents", "latents/**/*")
"""Patterns of acwm's own files in a data folder."""

UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, ArithmeticError)
"""Exceptions that reading a card raises if the file is not a card."""

FORMAT = 1
"""Version of the folder's layout, increased when older readers could misread it."""

PADDING = "A clip that is longer than its episode repeats the last frame, with zero actions."
"""Holds for clips of a fixed length. Training cuts clips of short episodes to whole latent frames
and pads only episodes too short for two of them: see `acwm_core.data.clips.clip_lengths`."""


@dataclass(frozen=True)
class DatasetCard:
    """``card.yaml`` of a data folder. With the same versions, it reproduces the same bytes.

    Attributes:
        environment: the environment's card, with the frame size of this dataset.
        splits: number of episodes per split.
        seed: seed of the dataset.
        options: constructor options of the environment, ``{"size": [64, 64]}``.
        factors: factor settings that override those of the splits.
        shard_episodes: episodes per shard; the last shard of a split may hold fewer.
        versions: versions of the platform, acwm and the packages that affect the bytes.
        actions: for each finished split, the mean, std, min and max of every action dimension.
        checksums: for each finished split, the SHA-256 of its shards' checksums, see `Manifest`.
        padding: how a clip longer than its episode is filled, see `PADDING`.
        format: version of the folder's layout.
        exploration: share of the training episodes that reuse the previous episode's actions.
        shift: by up to which share of half its range one dimension of those actions is shifted.
        source: for recorded data, what was imported: `kind`, e.g. ``"lerobot"``, `name`,
            checksums, the `command` if one did it, `notes` for people, and `unusable`, why
            nothing can be trained on it, if so. Empty if simulated.
    """

    environment: EnvironmentCard
    splits: Mapping[Split, int]
    seed: int
    options: Mapping[str, Any]
    factors: Mapping[str, FactorSetting]
    shard_episodes: int
    versions: Mapping[str, str]
    actions: Mapping[Split, Mapping[str, list[float]]] = field(
        default_factory=dict[Split, Mapping[str, list[float]]]
    )
    checksums: Mapping[Split, str] = field(default_factory=dict[Split, str])
    padding: str = PADDING
    format: int = FORMAT
    exploration: float = 0.0
    shift: float = 0.0
    source: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def command(self, out: Path | str, split: str = "all") -> str:
        """The command that makes this dataset, or another split of it, in the folder `out`."""
        if "command" in self.source:
            return f"{self.source['command']} --out {shlex.quote(str(out))}"
        if self.source:
            return "the program that wrote it"
        words = (f"factors.{name}={_text(value)}" for name, value in self.factors.items())
        factors = "".join(f" {shlex.quote(word)}" for word in words)
        exploration = f" --exploration {self.exploration}" if self.exploration else ""
        exploration += f" --shift {self.shift}" if self.shift else ""
        counts = ",".join(str(self.splits.get(split, 0)) for split in SPLITS)
        which = f"--episodes {counts}" if split == "all" else f"--split {split}"
        height, width = self.environment.frame_size
        return (
            f"acwm generate {self.environment.name}{factors} {which} --size {height}x{width} "
            f"--seed {self.seed}{exploration} --out {shlex.quote(str(out))}"
        )

    def of_tests(self, dataset: Mapping[str, Any]) -> DatasetCard:
        """The card of the simulated test data that an evaluation names.

        Args:
            dataset: the facts of these data in the evaluation's provenance.
        """
        splits = {split: count for split, count in dataset["episodes"].items() if split != "train"}
        size: Any = tuple(dataset["frame_size"])
        return replace(
            self,
            environment=replace(self.environment, frame_size=size),
            splits=cast(Mapping[Split, int], splits),
            seed=dataset["seed"],
            options=dataset["options"],
            factors=dataset["factors"],
            exploration=0.0,
            shift=0.0,
        )

    def holds(self, other: DatasetCard) -> bool:
        """Whether these data, simulated, hold the test episodes of `other`."""
        same = ("seed", "options", "factors")
        return (
            self.environment.frame_size == other.environment.frame_size
            and all(getattr(self, name) == getattr(other, name) for name in same)
            and all(self.splits.get(split) == count for split, count in other.splits.items())
        )

    @property
    def identity(self) -> str:
        """A hash of all that determines its episodes, however many there are, in 64 hex digits."""
        values = {k: v for k, v in _recipe(self).items() if not k.startswith("splits.")}
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

    def spec(self, split: Split, index: int) -> EpisodeSpec:
        """The spec of an episode."""
        name = self.environment.name
        return EpisodeSpec(name, split, index, self.seed, self.factors, self.options)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict, the inverse of `from_dict`."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values["environment"] = self.environment.to_dict()
        return cast(dict[str, Any], json.loads(json.dumps(values)))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> DatasetCard:
        """Read what `to_dict` wrote.

        Raises:
            one of `UNREADABLE`: the values are not a card.
        """
        typed(values, cls)  # checks only; its result is not used, so that an int stays an int
        others = {name: value for name, value in values.items() if name != "environment"}
        card = cls(environment=EnvironmentCard.from_dict(values["environment"]), **others)
        if not set(card.splits) <= set(SPLITS):  # they are names of folders
            raise ValueError(f"{dict(card.splits)} are not splits")
        for split, statistics in card.actions.items():
            if not all(math.isfinite(n) for row in statistics.values() for n in row):
                raise ValueError(f"the actions' statistics of {split} are not finite numbers")
        return card

    def write(self, folder: Path) -> None:
        """Write ``folder/card.yaml`` atomically."""
        with written_whole(folder / CARD) as partial:
            text = yaml.safe_dump(self.to_dict(), sort_keys=False, allow_unicode=True)
            partial.write_text(text, encoding="utf-8")

    @classmethod
    def read(cls, path: str | Path) -> DatasetCard:
        """Read the card of the data folder `path` (or the card file itself).

        Raises:
            DataError: there is no such folder or no card in it, or this version cannot read it.
        """
        path = Path(path)
        file = path if path.suffix == ".yaml" else path / CARD
        if file != path and path.is_dir():
            check_inside(path, *OWN)
        if not file.exists():
            raise DataError(
                f"there is no dataset in {file.parent}: make one with "
                f"`acwm generate ENVIRONMENT --out {shlex.quote(str(file.parent))}`"
            )
        check_fetched(file)
        try:
            values = cast(dict[str, Any], parse_yaml(file.read_text(encoding="utf-8")))
            version = values["format"]
            if version == FORMAT:
                return cls.from_dict(values)
        except (yaml.YAMLError, *UNREADABLE) as error:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            if isinstance(error, KeyError):
                reason = f"it has no {error.args[0]!s:.80}"
            raise DataError(f"{file} is not a dataset card ({reason})") from error
        raise DataError(
            f"{file} has layout version {version}, this acwm reads {FORMAT}: generate it again, "
            "or use the version of acwm that it names"
        )

    def differences(self, other: DatasetCard) -> list[str]:
        """How the dataset of `other` would differ; splits that only one of them has don't count.

        Returns:
            Phrases such as ``"seed is 0 there, 1 now"``; "there" is `self`, "now" is `other`.
        """
        if bool(self.source) != bool(other.source):
            how = {True: "recorded", False: "simulated"}
            return [f"it was {how[bool(self.source)]} there, is {how[bool(other.source)]} now"]
        there, now = _recipe(self), _recipe(other)
        changes: list[str] = []
        for name in sorted({**there, **now}):
            before, after = there.get(name, "not set"), now.get(name, "not set")
            only_one = name not in there or name not in now
            if before != after and not (name.startswith("splits.") and only_one):
                changes.append(f"{name} is {before} there, {after} now")
        return changes

    def has_data_of(self, other: DatasetCard) -> bool:
        """Whether both datasets have the same training episodes, wherever these come from."""
        ours, theirs = self.checksums.get("train"), other.checksums.get("train")
        if ours and ours == theirs:
            ours, theirs = (_recipe(card, "environment") for card in (self, other))
            return ours == theirs
        # A simulation that is repeated on another machine may differ in its last bits.
        is_repeated = not (self.source and ours and theirs)
        return is_repeated and not self.differences(other)


def other_dataset(folder: Path, differences: Iterable[str]) -> DataError:
    """The error that the folder to write a dataset to holds one with these `differences`."""
    return DataError(
        f"{folder} holds another dataset: {'; '.join(differences)}. Choose another folder, or "
        "delete this one to create it again"
    )


def package_versions(packages: Iterable[str] = ()) -> dict[str, str]:
    """Versions of the platform, acwm, NumPy, PyAV and `packages`."""
    versions = {"platform": f"{platform.system()} {platform.machine()}"}
    for package in ("acwm", "numpy", "av", *packages):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "unknown"
    return versions


def _text(value: FactorSetting) -> str:
    """A factor's setting as it is typed."""
    return value if isinstance(value, str) else json.dumps(value)


def _recipe(card: DatasetCard, begin: str = "") -> dict[str, Any]:
    """All values that determine the bytes, flat: ``{"seed": 0, "environment.fps": 10, …}``.

    Args:
        begin: of these, the values whose names begin with it.
    """
    values = replace(card, environment=card.environment.recorded).to_dict()
    del values["actions"], values["checksums"]
    values["source"].pop("notes", None)
    if not values["shift"]:  # data from before there were shifts is the same data
        del values["shift"]
    return {name: value for name, value in flat_items(values) if name.startswith(begin)}
