"""Episodes: the request (`EpisodeSpec`), factors of variation (`Factor`), the result (`Episode`).

Only NumPy is needed: simulators and data tools import this without torch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import RecipeError, ShapeError, suggest

Split = Literal["train", "ind_test", "ood_test"]
"""`train` and `ind_test` draw from the same distribution; `ood_test` shifts one factor."""

SPLITS: tuple[Split, ...] = get_args(Split)

FactorValue = float | int | str
"""A concrete value of a factor: a number or the name of a choice."""

FactorSetting = FactorValue
"""The setting of a factor in a spec: ``"train"``, ``"ood"``, ``"nominal"``, or a concrete value."""

REGIONS = ("train", "ood", "nominal")


def plain_unit(unit: str) -> str:
    """A unit as it is shown: nothing for pure numbers, whose unit in SI is ``"1"``."""
    return "" if unit == "1" else unit


@dataclass(frozen=True)
class Factor:
    """One factor of variation of an environment, with its train and out-of-distribution ranges.

    Build it with `Factor.continuous` or `Factor.discrete`.

    Attributes:
        name: e.g. ``"friction"``; on the command line, ``factors.friction=ood`` sets it.
        description: one phrase, for tables.
        kind: ``"continuous"`` (ranges) or ``"discrete"`` (listed values; if these are integers,
            the integers between them can be requested as well).
        nominal: value if the factor is neither active nor set.
        train: ``(low, high)``, or the listed training values.
        ood: ``((low, high), …)``, or the listed out-of-distribution values.
        unit: unit of a continuous value, e.g. ``"kg"``; empty if it has none.
        active: whether it is drawn from `train` in every episode; otherwise it stays `nominal`.
    """

    name: str
    description: str
    kind: Literal["continuous", "discrete"]
    nominal: FactorValue
    train: tuple[Any, ...]
    ood: tuple[Any, ...]
    unit: str = ""
    active: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", plain_unit(self.unit))

    @classmethod
    def continuous(
        cls,
        name: str,
        description: str,
        *,
        train: tuple[float, float],
        ood: tuple[tuple[float, float], ...],
        nominal: float,
        unit: str = "",
        active: bool = False,
    ) -> Factor:
        """A factor drawn uniformly from an interval; `ood` lists one or more intervals."""
        return cls(name, description, "continuous", nominal, train, ood, unit, active)

    @classmethod
    def discrete(
        cls,
        name: str,
        description: str,
        *,
        train: tuple[FactorValue, ...],
        ood: tuple[FactorValue, ...],
        nominal: FactorValue,
        active: bool = False,
    ) -> Factor:
        """A factor drawn uniformly from listed values (numbers or names)."""
        return cls(name, description, "discrete", nominal, train, ood, "", active)

    @property
    def values(self) -> tuple[FactorValue, ...]:
        """The listed values of a discrete factor, without duplicates."""
        return tuple(dict.fromkeys((*self.train, *self.ood)))

    @property
    def counts(self) -> bool:
        """Whether it is discrete with integer values; then integers in between are allowed, too."""
        return self.kind == "discrete" and all(type(value) is int for value in self.values)

    def draw(self, setting: FactorSetting, rng: np.random.Generator) -> FactorValue:
        """The value for `setting`: drawn from a region, or the setting itself.

        Raises:
            RecipeError: the setting is neither a region nor a possible value of this factor.
        """
        if setting == "nominal":
            return self.nominal
        if setting in ("train", "ood"):
            region = self.train if setting == "train" else self.ood
            if self.kind == "discrete":
                return cast(FactorValue, region[int(rng.integers(len(region)))])
            intervals = (region,) if setting == "train" else region
            low, high = map(float, intervals[int(rng.integers(len(intervals)))])
            return rng.uniform(low, high)
        asked = f"factors.{self.name}={setting}"
        if self.kind == "continuous":
            if isinstance(setting, str):
                raise RecipeError(f"{asked}: give train, ood, nominal or a number")
            return float(setting)
        values = cast(tuple[int, ...], self.values)
        between = self.counts and type(setting) is int and min(values) <= setting <= max(values)
        if setting not in values and not between:
            known = [*REGIONS, *map(str, values)]
            raise RecipeError(f"{asked} is not possible{suggest(str(setting), known)}")
        return setting

    def severity(self, value: FactorValue) -> float:
        """How far `value` lies outside training: 0 inside, 1 at the furthest declared value.

        For numbers, severity is linear in the distance to the training range (and exceeds 1 beyond
        the declared ranges). For a named choice, it is 0 or 1.
        """
        if any(isinstance(v, str) for v in (*self.train, value)):
            return 0.0 if value in self.train else 1.0
        low, high = min(self.train), max(self.train)
        numbers = np.array([value, *np.ravel(self.ood)], float)
        distance, *declared = np.maximum(0, np.maximum(low - numbers, numbers - high)).tolist()
        furthest = max(declared)
        return distance / furthest if furthest > 0 else float(distance > 0)


@dataclass(frozen=True)
class EpisodeSpec:
    """Everything that determines an episode; the same spec gives the same bytes.

    Attributes:
        environment: registered name.
        split: determines where factors are drawn from.
        index: index of the episode within its split.
        seed: seed of the dataset.
        factors: settings that override those of the split, by factor name.
        options: constructor options of the environment, e.g. ``{"size": 64}``.
    """

    environment: str
    split: Split = "train"
    index: int = 0
    seed: int = 0
    factors: Mapping[str, FactorSetting] = field(default_factory=dict[str, FactorSetting])
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise RecipeError(f"unknown split {self.split!r}{suggest(self.split, SPLITS)}")
        if self.index < 0:
            raise RecipeError(f"episode index {self.index} is negative")

    def rng(self, stream: str) -> np.random.Generator:
        """A separate counter-based generator for each `stream` of randomness.

        Factors and options do not affect the seed: the same episode with another friction draws the
        same values for everything else, which a sweep over severities needs.
        """
        identity = [self.environment, self.split, self.index, self.seed, stream]
        digest = hashlib.sha256(json.dumps(identity).encode()).digest()
        return np.random.Generator(np.random.Philox(key=int.from_bytes(digest[:16], "little")))

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready dict, the inverse of `from_dict`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> EpisodeSpec:
        """The inverse of `to_dict`."""
        return cls(**fields)


@dataclass(frozen=True)
class Episode:
    """One simulated episode of T frames.

    Attributes:
        spec: the spec that it was made from.
        video: ``[T, H, W, 3]`` uint8.
        actions: ``[T, A]`` float32, raw units; row i leads from frame i to i + 1, the last row is
            zero.
        states: named ground truth, each ``[T, …]``; the card's state fields describe them.
        masks: ``[T, H, W]`` uint8 instance ids; the card's `instances` names them, 0 is background.
        contacts: ``[K, 3]`` int32 rows ``(frame, id, id)``: the two instances (smaller id first)
            touched during the interval that ended in that frame.
        factors: the concrete value of every factor in this episode.
        ood_label: the factors shifted out of distribution, in the format of `ood_label`, or None.
    """

    spec: EpisodeSpec
    video: NDArray[np.uint8]
    actions: NDArray[np.float32]
    states: Mapping[str, NDArray[Any]]
    masks: NDArray[np.uint8]
    contacts: NDArray[np.int32]
    factors: Mapping[str, FactorValue]
    ood_label: str | None

    def __post_init__(self) -> None:
        frames = len(self.video)
        lengths = {"actions": len(self.actions), "masks": len(self.masks)}
        lengths |= {f"states[{name!r}]": len(values) for name, values in self.states.items()}
        for name, length in lengths.items():
            if length != frames:
                raise ShapeError(f"{name} has {length} rows for {frames} frames of video")
        if self.video.dtype != np.uint8 or self.video.ndim != 4:
            raise ShapeError(f"video is {self.video.dtype} {self.video.shape}, not uint8 [T,H,W,3]")
        if frames and np.any(self.actions[-1]):
            raise ShapeError("the last row of actions leads to no frame and must be zero")

    def digests(self) -> dict[str, str]:
        """A hash of each array by name, and of factors and `ood_label` as ``"factors"``."""
        content = {f"state {name!r}": values.tobytes() for name, values in self.states.items()}
        content |= {name: getattr(self, name).tobytes() for name in ("actions", "contacts")}
        content |= {"masks": self.masks.tobytes(), "video": self.video.tobytes()}
        content["factors"] = repr((self.factors, self.ood_label)).encode()
        return {name: hashlib.sha256(values).hexdigest() for name, values in content.items()}


def draw_factors(
    spec: EpisodeSpec, factors: tuple[Factor, ...], ood_shifts: tuple[str, ...]
) -> dict[str, FactorValue]:
    """Draw the value of every factor in the episode `spec`.

    `ood_test` shifts one of `ood_shifts` per episode, in turn, so that each label gets an equal
    share. Active factors are drawn from their training range; the others stay nominal. Settings in
    `spec.factors` take precedence over all of this.

    Raises:
        RecipeError: `spec.factors` has an unknown factor or an impossible value.
    """
    names = [factor.name for factor in factors]
    for name in spec.factors:
        if name not in names:
            raise RecipeError(f"{spec.environment} has no factor {name!r}{suggest(name, names)}")
    shifts = ood_shifts if spec.split == "ood_test" else ()
    shifted = shifts[spec.index % len(shifts)] if shifts else ""
    values: dict[str, FactorValue] = {}
    for factor in factors:
        usual = "ood" if factor.name == shifted else "train" if factor.active else "nominal"
        setting = spec.factors.get(factor.name, usual)
        values[factor.name] = factor.draw(setting, spec.rng(f"factor:{factor.name}"))
    return values


def ood_label(factors: tuple[Factor, ...], values: Mapping[str, FactorValue]) -> str | None:
    """The factors whose value lies outside training, joined by ``"+"``; None if there is none.

    A discrete factor includes its value: ``"direction=north"``, ``"friction+cube_count=5"``.
    """
    shifted = [f for f in factors if f.severity(values[f.name]) > 0]
    labels = [f"{f.name}={values[f.name]}" if f.kind == "discrete" else f.name for f in shifted]
    return "+".join(labels) or None
