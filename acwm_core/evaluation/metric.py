"""A `Prediction` of a clip, and the `Metric` that scores one and summarises many."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import Episode, plain_unit
from acwm_core.env.physics import Observation, StateEstimator
from acwm_core.errors import PluginError, ShapeError, check_shape, noting
from acwm_core.evaluation.clips import Clip, Predictor, as_clip

if TYPE_CHECKING:
    from acwm_core.model import shapes

Result = TypeVar("Result")

Numbers = Sequence[float] | NDArray[np.float64]
"""One number per clip."""


@dataclass(frozen=True)
class Prediction:
    """A predicted clip of T frames, the true one, and what the simulator knows about it.

    Attributes:
        video: the predicted frames, `[T, 3, H, W]` float32 in [0, 1].
        target: the true ones, like `video`; frame 0 was given to the model.
        actions: `[T, A]` raw actions of the true clip.
        states: ground-truth arrays by name, each `[T, …]`.
        masks: `[T, H, W]` uint8 instance ids.
        contacts: `[K, 3]` rows (frame, id, id).
        card: the environment's card.
        estimator: reads states and masks from video of this environment; None if there is none.
        branches: predictions of other actions from the same first frame, each with the video that
            the simulator makes of them as `target`; empty unless requested.
        draws: all draws of the clip, of which `video` is the first; a single one if the model is
            deterministic. Empty unless several are requested.
        clip: the clip of the evaluation.
        kind: its predictor, see `acwm_core.evaluation.clips.Predictor`.
        ood_label: the factors of the episode that were shifted out of distribution, if any.
    """

    video: shapes.Clip
    target: shapes.Clip
    actions: NDArray[np.float32]
    states: Mapping[str, NDArray[Any]]
    masks: NDArray[np.uint8]
    contacts: NDArray[np.int32]
    card: EnvironmentCard
    estimator: StateEstimator | None = None
    branches: tuple[Prediction, ...] = ()
    draws: tuple[Prediction, ...] = ()
    clip: Clip = field(default_factory=Clip)
    kind: Predictor = "model"
    ood_label: str | None = None

    @classmethod
    def of(
        cls,
        episode: Episode,
        video: shapes.Clip,
        target: shapes.Clip,
        card: EnvironmentCard,
        estimator: StateEstimator | None = None,
    ) -> Prediction:
        """A prediction of an episode, whose own video as a tensor is `target`."""
        truth = episode.actions, episode.states, episode.masks, episode.contacts
        return cls(video, target, *truth, card, estimator, ood_label=episode.ood_label)

    @classmethod
    def truth(
        cls,
        episode: Episode,
        card: EnvironmentCard,
        estimator: StateEstimator | None = None,
        clip: Clip | None = None,
    ) -> Prediction:
        """An episode's own video, as a prediction of itself."""
        video = as_clip(episode.video)
        truth = cls.of(episode, video, video, card, estimator)
        return replace(truth, clip=clip or truth.clip, kind="truth")

    def without(self, frames: int) -> Prediction:
        """The prediction without its first `frames` frames, as if the clip had begun later."""
        if not frames:
            return self  # with all that is known of it
        contacts = self.contacts - np.array([frames, 0, 0], self.contacts.dtype)
        return replace(
            self,
            video=self.video[frames:],
            target=self.target[frames:],
            actions=self.actions[frames:],
            states={name: values[frames:] for name, values in self.states.items()},
            masks=self.masks[frames:],
            contacts=contacts[contacts[:, 0] >= 0],
            branches=tuple(branch.without(frames) for branch in self.branches),
            draws=tuple(draw.without(frames) for draw in self.draws),
        )

    def check_shapes(self) -> None:
        """Raise a `ShapeError` unless video and target have the same shape, with some frames.

        So must the true masks and states, frame by frame.
        """
        video, target = list(self.video.shape), list(self.target.shape)
        if video != target or len(target) != 4 or not target[0]:
            raise ShapeError(
                f"metrics compare two clips [T, 3, H, W] of one shape, not {video} with {target}"
            )
        for name, values in {"masks": self.masks, **self.states}.items():
            if len(values) != target[0]:
                raise ShapeError(
                    f"a clip of {target[0]} frames has {name} of {len(values)}: cut both alike"
                )

    @functools.cached_property
    def observed(self) -> Observation:
        """The estimator's reading of the video, computed once for all metrics.

        Raises:
            PluginError: there is no estimator; a metric that needs one must say so in
                `unavailable`.
            ShapeError: the prediction is longer or shorter than the truth.
        """
        self.check_shapes()
        if self.estimator is None:
            raise PluginError(f"no estimator reads states from video of {self.card.name}")
        return self.estimator.read(self.video)

    @functools.cached_property
    def is_finite(self) -> bool:
        """Whether its video and those of all branches and draws are free of NaN and infinity."""
        own = bool(self.video.isfinite().all())
        return own and all(prediction.is_finite for prediction in (*self.branches, *self.draws))

    def once(self, key: object, work_out: Callable[[], Result]) -> Result:
        """Compute a value that several metrics of this clip share, only once.

        Args:
            key: a unique key, such as the function that computes the value.
            work_out: computes the value. Metrics share it, so they must not change it.
        """
        if key not in self._shared:
            self._shared[key] = work_out()
        return self._shared[key]

    @functools.cached_property
    def _shared(self) -> dict[object, Any]:
        return {}


Reads = Literal["pixels", "states"]
"""What a metric uses of the predicted video: pixels (or features of them), compared with the true
ones; or states that an estimator reads from it, whose errors give them a noise floor."""


@dataclass(frozen=True)
class MetricInfo:
    """What tables and charts need to know about a metric; stored with the scores.

    Attributes are those of `Metric`; `title` is ``""`` in results of older versions.
    """

    unit: str
    higher_is_better: bool
    title: str = ""
    group: str = ""
    reads: Reads = "states"
    factor: float | None = None
    rank: int = 100
    definition: int = 1
    right: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "unit", plain_unit(self.unit))


class Metric(ABC):
    """A score of predicted video, computed in float32 and outside autocast.

    One instance scores many clips, possibly several at once in different threads, so its methods
    must not keep state between calls or change their arguments.

    Attributes:
        name: column name in results, e.g. ``"psnr"``.
        title: name in tables, e.g. ``"PSNR"``; by default the name in words.
        unit: e.g. ``"dB"``; ``""`` for none.
        higher_is_better: whether higher values are better.
        bounds: the lowest and highest possible score; confidence intervals end there.
        group: heading above its column in tables, e.g. ``"Pixels"``.
        reads: whether it compares pixels or reads states, see `Reads`.
        factor: displayed values are multiplied by it; None chooses 1 or 1000 by their size.
        rank: its order in tables, lowest first; the metric with the lowest rank orders the clips.
        of_branches: whether it compares a clip with its branches. It is then measured only on the
            clips of the counterfactual test (`evaluation.counterfactual_metrics`).
        of_draws: whether it judges the draws of a clip together (`Prediction.draws`). It is then
            measured only if several are asked for (`evaluation.samples`). A prediction without
            draws, such as the copied first frame, counts as one draw or is not defined.
        definition: number of its definition; scores of different ones do not compare.
        right: the right score, where neither a higher nor a lower one is better; else None.
    """

    name: str
    title: str = ""
    unit: str = ""
    higher_is_better: bool = False
    bounds: tuple[float, float] = (-math.inf, math.inf)
    group: str = "Other"
    reads: Reads = "states"
    factor: float | None = None
    rank: int = 100
    of_branches: bool = False
    of_draws: bool = False
    definition: int = 1
    right: float | None = None

    @property
    def info(self) -> MetricInfo:
        """What tables and charts need to know about it."""
        title = self.title or self.name.replace("_", " ").capitalize()
        facts = self.group, self.reads, self.factor, self.rank, self.definition, self.right
        return MetricInfo(self.unit, self.higher_is_better, title, *facts)

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """Why this environment cannot be scored, in one sentence; None if it can.

        Args:
            card: the environment's card.
            estimator: the later `Prediction.estimator`.
        """
        return None

    def provenance(self) -> Mapping[str, str]:
        """What else the scores depend on, e.g. the hash of a network's weights."""
        return {}

    @abstractmethod
    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The score of each frame, `[T]`; NaN where it is not defined."""

    def value(self, prediction: Prediction) -> float:
        """The score of the whole clip; the mean over frames with a defined score unless overridden.

        NaN means not defined; the clip then counts in no summary. It is called only for finite
        predictions; others get the score `worst`.
        """
        return mean_of_defined(self.per_frame(prediction))

    @property
    def worst(self) -> float:
        """The score of a prediction that is not finite: infinitely bad."""
        return -math.inf if self.higher_is_better else math.inf

    def weight(self, prediction: Prediction) -> float:
        """Weight of the clip in `summarise`; 1 unless overridden."""
        return 1.0

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the clip whose score is based on detections, in [0, 1]; NaN if there is none.

        By default it is the share of frames with a defined score. A metric that scores
        undetected objects, for example at their last position, returns the detected share.

        Args:
            curve: the result of `curve` for the clip.
        """
        return float((~np.isnan(curve)).mean())

    def curve(self, prediction: Prediction) -> NDArray[np.float64]:
        """Call `per_frame`; `PluginError` unless the result has one number per frame.

        Raises:
            ShapeError: prediction and truth have other lengths or sizes.
        """
        prediction.check_shapes()
        scores = np.asarray(self.per_frame(prediction), np.float64)
        check_shape(self, "per_frame", scores, len(prediction.target))
        return scores

    def scored(
        self, prediction: Prediction, curve: NDArray[np.float64] | None = None
    ) -> tuple[float, float]:
        """The value and weight of a clip; `worst` and 1 if the prediction is not finite.

        Args:
            curve: the result of `curve` for the clip, if it is known already.

        Raises:
            PluginError: the weight is negative or not finite.
            ShapeError: as in `curve`.
        """
        prediction.check_shapes()
        if not prediction.is_finite:
            return self.worst, 1.0
        if type(self).value is Metric.value:
            value = mean_of_defined(self.curve(prediction) if curve is None else curve)
        else:
            value = float(self.value(prediction))
        weight = float(self.weight(prediction))
        if not 0 <= weight < math.inf:
            raise PluginError(f"{type(self).__name__}.weight gives {weight}, not at least 0")
        return value, weight

    def summed_up(self, values: Numbers, weights: Numbers | None = None) -> float:
        """Call `summarise`; errors get a note that names the metric."""
        with noting(f"in metric {self.name!r} while summarising clips", self):
            return float(self.summarise(values, weights))

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """Summarise many clips in one number: the weighted mean of the values unless overridden.

        Args:
            values: `value` of each clip; never NaN, but possibly `worst`.
            weights: `weight` of each clip, times how often it counts; all equal if None.
        """
        return float(np.average(values, weights=weights))


class SetMetric(Metric):
    """A distance between the set of predicted clips and the set of true clips.

    Single clips have no score; only summaries are reported. These have no confidence interval,
    because such distances grow with fewer clips, and a resample has fewer different clips.
    """

    @abstractmethod
    def features(self, prediction: Prediction) -> NDArray[np.float32]:
        """Features of a clip: a vector for the prediction and one for the target, `[2, D]`."""

    @abstractmethod
    def distance(self, features: NDArray[np.float32]) -> float:
        """The score of N clips from their `features`, `[N, 2, D]`; NaN if N is too small.

        It is 0 for equal sets.
        """

    def distance_of(self, clips: Sequence[object]) -> float:
        """Call `distance` on the `features` of clips; errors get a note as in `summed_up`."""
        with noting(f"in metric {self.name!r} while summarising clips", self):
            return float(self.distance(np.asarray(clips, np.float32)))

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """All NaN, `[T]`: single frames have no score."""
        return np.full(len(prediction.target), np.nan)


def mean_of_defined(scores: NDArray[np.float64]) -> float:
    """The mean of the scores that are not NaN; NaN if all are."""
    defined = scores[~np.isnan(scores)]
    return float(defined.mean()) if len(defined) else float("nan")
