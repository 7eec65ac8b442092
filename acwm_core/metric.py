"""The `Metric` interface: scores one predicted episode, and sums up many."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_core.episode import Episode
from acwm_core.errors import PluginError, ShapeError
from acwm_core.errors.plugin_code import WrongResultError, blaming, numbers
from acwm_core.estimator import Observation, StateEstimator

if TYPE_CHECKING:
    from acwm_core.shapes import Clip

Result = TypeVar("Result")

Numbers = Sequence[float] | NDArray[np.float64]
"""One number per clip."""


@dataclass(frozen=True)
class Rollout:
    """A predicted clip beside the truth and all that the simulator knows of it.

    Attributes:
        prediction: `[T, 3, H, W]` float32 in [0, 1].
        target: the simulated video, like `prediction`; frame 0 was given to the model.
        actions: `[T, A]` raw actions.
        states: ground-truth arrays by name, each `[T, …]`.
        masks: `[T, H, W]` uint8 instance ids.
        contacts: `[K, 3]` rows (frame, id, id).
        card: the environment's card.
        estimator: reads states and masks from video of this environment; None if there is none.
        branches: other actions from the same first frame, each with the video that the simulator
            makes of them as `target`; empty unless they were asked for.
    """

    prediction: Clip
    target: Clip
    actions: NDArray[np.float32]
    states: Mapping[str, NDArray[Any]]
    masks: NDArray[np.uint8]
    contacts: NDArray[np.int32]
    card: EnvironmentCard
    estimator: StateEstimator | None = None
    branches: tuple[Rollout, ...] = ()

    @classmethod
    def of(
        cls,
        episode: Episode,
        target: Clip,
        prediction: Clip,
        card: EnvironmentCard,
        estimator: StateEstimator | None = None,
    ) -> Rollout:
        """A prediction of an episode, whose own video is `target`."""
        known = episode.actions, episode.states, episode.masks, episode.contacts
        return cls(prediction, target, *known, card, estimator)

    def check_shapes(self) -> None:
        """Make sure that there are two clips to compare.

        Raises:
            ShapeError: prediction and target differ in shape, or hold no frame.
        """
        prediction, target = list(self.prediction.shape), list(self.target.shape)
        if prediction != target or len(target) != 4 or not target[0]:
            raise ShapeError(
                f"metrics compare two clips [T, 3, H, W] of one shape, not {prediction} with "
                f"{target}"
            )

    @functools.cached_property
    def observed(self) -> Observation:
        """What the estimator sees in the prediction; worked out once for all metrics.

        Raises:
            PluginError: there is no estimator; a metric that needs one says so in `unavailable`.
        """
        if self.estimator is None:
            raise PluginError(f"nothing reads states from video of {self.card.name}")
        return self.estimator.read(self.prediction)

    @functools.cached_property
    def is_finite(self) -> bool:
        """Whether the prediction, and that of every branch, holds neither NaN nor infinity."""
        own = bool(self.prediction.isfinite().all())
        return own and all(branch.is_finite for branch in self.branches)

    def once(self, key: object, work_out: Callable[[], Result]) -> Result:
        """What metrics of this clip have in common, worked out for the first that asks for it.

        Args:
            key: a key of its own, such as the function that works it out.
            work_out: does it; what it returns is shared, so leave it as it is.
        """
        if key not in self._shared:
            self._shared[key] = work_out()
        return self._shared[key]

    @functools.cached_property
    def _shared(self) -> dict[object, Any]:
        return {}


Reads = Literal["pixels", "states"]
"""What a metric takes from the predicted video: pixels (or features of them), which it compares
with the true ones, or states, which an estimator reads from it and which so have a noise floor."""


@dataclass(frozen=True)
class MetricInfo:
    """What tables and charts need to know of a metric; kept with the scores.

    Attributes are those of `Metric`; `title` is ``""`` in results of old.
    """

    unit: str
    higher_is_better: bool
    title: str = ""
    group: str = ""
    reads: Reads = "states"
    factor: float | None = None
    rank: int = 100


class Metric(ABC):
    """A score of predicted video, in float32 and outside autocast.

    One instance scores many clips, several at once in different threads: the methods keep nothing
    between calls and leave what they are given as it is.

    Attributes:
        name: column name in results, e.g. ``"psnr"``.
        title: how it is called in tables, e.g. ``"PSNR"``; by default the name in words.
        unit: e.g. ``"dB"``; ``""`` for none.
        higher_is_better: which way is good.
        group: heading of the columns that it stands among in tables, e.g. ``"Pixels"``.
        reads: whether it compares pixels or reads states, see `Reads`.
        factor: shown values are multiplied by it; None chooses 1 or 1000 by their size.
        rank: its place among others in tables, lowest first; the lowest ranks the clips.
        of_branches: compares a clip's branches with it, and so is measured on the clips of the
            counterfactual test alone (`evaluation.counterfactual_metrics`).
    """

    name: str
    title: str = ""
    unit: str = ""
    higher_is_better: bool = False
    group: str = "Other"
    reads: Reads = "states"
    factor: float | None = None
    rank: int = 100
    of_branches: bool = False

    @property
    def info(self) -> MetricInfo:
        """What tables and charts need to know of it."""
        title = self.title or self.name.replace("_", " ").capitalize()
        shown = self.group, self.reads, self.factor, self.rank
        return MetricInfo(self.unit, self.higher_is_better, title, *shown)

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """Why this environment cannot be scored, in a sentence; None if it can.

        Args:
            estimator: what `Rollout.estimator` will be.
        """
        return None

    def provenance(self) -> Mapping[str, str]:
        """What else the scores depend on, e.g. the hash of the weights of a network."""
        return {}

    @abstractmethod
    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """The score of each frame, `[T]`; NaN where it is not defined."""

    def value(self, rollout: Rollout) -> float:
        """The score of the whole clip; the mean of the defined frames unless overridden.

        NaN where it is not defined; then the clip counts in no summary. Only finite predictions are
        asked for: others score `worst`.
        """
        return mean_of_defined(self.per_frame(rollout))

    @property
    def worst(self) -> float:
        """The score of a prediction that is not finite: infinitely bad, whatever it measures."""
        return -math.inf if self.higher_is_better else math.inf

    def weight(self, rollout: Rollout) -> float:
        """How much the clip counts in `summarise`; 1 unless overridden."""
        return 1.0

    def curve(self, rollout: Rollout) -> NDArray[np.float64]:
        """What `per_frame` gives; `WrongResultError` unless it is a number for each frame."""
        return numbers(self, "per_frame", self.per_frame(rollout), len(rollout.target))

    def scored(
        self, rollout: Rollout, curve: NDArray[np.float64] | None = None
    ) -> tuple[float, float]:
        """The value and weight of a clip; of a prediction that is not finite, `worst`.

        Args:
            curve: that of the clip, if it is there already.

        Raises:
            WrongResultError: they are no numbers, or the weight is negative or not finite.
        """
        if not rollout.is_finite:
            return self.worst, 1.0
        if type(self).value is Metric.value:
            value = mean_of_defined(self.curve(rollout) if curve is None else curve)
        else:
            value = float(numbers(self, "value", self.value(rollout)))
        weight = float(numbers(self, "weight", self.weight(rollout)))
        if not 0 <= weight < math.inf:
            raise WrongResultError(self, "weight", weight, "a finite number of at least 0")
        return value, weight

    def summed_up(self, values: Numbers, weights: Numbers | None = None) -> float:
        """What `summarise` gives; `PluginError` if that is no number, or it raised."""
        with blaming("when it sums clips up", self):
            return float(numbers(self, "summarise", self.summarise(values, weights)))

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """One number for many clips: the weighted mean of their `value`s unless overridden.

        Args:
            values: `value` of each clip, none of them NaN, but `worst` may be among them.
            weights: `weight` of each clip, times how often it counts; all equal if None.
        """
        return float(np.average(values, weights=weights))


class SetMetric(Metric):
    """A distance between the set of predicted clips and the set of the true ones.

    No clip has a score of its own: only summaries are reported, and they have no interval, because
    such distances grow as the clips get fewer and a resample holds fewer different ones.
    """

    @abstractmethod
    def features(self, rollout: Rollout) -> NDArray[np.float32]:
        """What the sets are made of: a vector for the prediction, one for the target, `[2, D]`."""

    @abstractmethod
    def distance(self, features: NDArray[np.float32]) -> float:
        """The score of the clips whose `features` are given, `[N, 2, D]`; NaN if they are too few.

        It is 0 for equal sets.
        """

    def distance_of(self, clips: Sequence[object]) -> float:
        """What `distance` gives of the `features` of clips; `PluginError` as in `summed_up`."""
        with blaming("when it sums clips up", self):
            features = numbers(self, "features", clips, len(clips), 2, -1).astype(np.float32)
            return float(numbers(self, "distance", self.distance(features)))

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Not defined, `[T]`."""
        return np.full(len(rollout.target), np.nan)


def mean_of_defined(scores: NDArray[np.float64]) -> float:
    """The mean of the scores that are not NaN; NaN if all are."""
    defined = scores[~np.isnan(scores)]
    return float(defined.mean()) if len(defined) else float("nan")
