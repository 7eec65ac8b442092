"""Adapts torchmetrics' image metrics to acwm, and acwm's metrics to `torchmetrics.Metric`."""

from __future__ import annotations

import importlib
import inspect
import threading
from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
import torchmetrics
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.env.episode import Episode
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import PluginError, RecipeError, ShapeError
from acwm_core.evaluation.metric import Metric, Prediction, SetMetric
from acwm_core.model.shapes import check_pixels
from acwm_core.plugins import catalog
from acwm_core.recipe.metrics import own_name

if TYPE_CHECKING:
    from acwm_core.model.shapes import Clip, Video

FRAMES_IN_UNIT_RANGE = {"data_range": 1.0, "normalize": True}
"""Parameters that tell metrics of torchmetrics that values lie in [0, 1]."""


class TorchMetric(Metric):
    """A metric of torchmetrics that compares images.

    It gets predicted and true frames, `[N, 3, H, W]` in [0, 1]: one at a time for the score of each
    frame, and all frames of a clip together for the clip's score.

    Args:
        metric_class: dotted name, e.g. ``"torchmetrics.image.SpectralAngleMapper"``; recipes use it
            in place of the metric's name.
        **params: parameters of its constructor. A ``data_range`` is 1 unless given.

    Raises:
        RecipeError: there is no such class, it needs something that is not installed, it cannot be
            created with these parameters, or it does not compare images.
    """

    group = "Pixels"
    reads = "pixels"

    def __init__(self, metric_class: str = "", **params: Any) -> None:
        made = _class(metric_class)
        takes = inspect.signature(made.__init__).parameters
        for name, value in FRAMES_IN_UNIT_RANGE.items():
            # In other metrics `normalize` is not a flag and means something else.
            if name in takes and (name == "data_range" or takes[name].default is False):
                params.setdefault(name, value)
        try:
            self._metric: Any = made(**params)
        except (TypeError, ValueError, ImportError) as error:
            raise RecipeError(f"{metric_class} cannot be made: {_one_line(error)}") from error
        given = list(inspect.signature(self._metric.update).parameters)
        if given[:2] != ["preds", "target"]:
            raise RecipeError(
                f"{metric_class} does not compare pictures: it takes {', '.join(given)}, not "
                "preds and target"
            )
        if self._metric.higher_is_better is None:
            raise RecipeError(f"{metric_class} does not say whether higher is better")
        self.name = own_name(metric_class)
        self.title = self.name.replace("_", " ").capitalize()
        self.higher_is_better = bool(self._metric.higher_is_better)
        self._class = metric_class
        self._lock = threading.Lock()  # an instance accumulates state until it is reset

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """Its error message, if any, for two noise images of this size."""
        generator = torch.Generator().manual_seed(0)
        frames = torch.rand((2, 1, 3, *card.frame_size), generator=generator)
        try:
            self._score(*frames)
        except Exception as error:  # torchmetrics raises many kinds
            height, width = card.frame_size
            return f"{self._class} takes no frames of {height}×{width}: {_one_line(error)}"
        return None

    def provenance(self) -> dict[str, str]:
        """The class and the version of torchmetrics."""
        return {"class": self._class, "torchmetrics": version("torchmetrics")}

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """Score of each frame by itself, `[T]`."""
        predicted, true = self._clips(prediction)
        return np.array([self._score(predicted[t, None], true[t, None]) for t in range(len(true))])

    def value(self, prediction: Prediction) -> float:
        """Score of all frames of the clip together."""
        return self._score(*self._clips(prediction))

    def _clips(self, prediction: Prediction) -> tuple[Clip, Clip]:
        prediction.check_shapes()
        return prediction.video.detach().cpu().float(), prediction.target.detach().cpu().float()

    def _score(self, prediction: Clip, target: Clip) -> float:
        with self._lock, torch.no_grad():
            self._metric.reset()
            self._metric.update(prediction, target)
            score = float(self._metric.compute())
            self._metric.reset()
        return score


def as_torchmetric(
    metric: str | Metric,
    *,
    card: EnvironmentCard | None = None,
    estimator: StateEstimator | None = None,
    **params: Any,
) -> RolloutMetric:
    """Wrap an acwm metric as a `torchmetrics.Metric`, e.g. for a trainer's `validation_step`.

    Args:
        metric: registered name, or the metric itself.
        card: card of the environment; needed by metrics that read states.
        estimator: reads states from video; needed by metrics that read states.
        **params: constructor parameters, if `metric` is a name.
    """
    made = catalog().create("metric", metric, **params) if isinstance(metric, str) else metric
    return RolloutMetric(made, card, estimator)


class RolloutMetric(torchmetrics.Metric):
    """Scores batches of predicted clips; `compute` summarises them as an evaluation does.

    The score and weight of each clip are kept, and gathered from all processes.

    Args:
        metric: scores the clips.
        card: card of the environment; by default one that only has the frame size.
        estimator: reads states from video.

    Raises:
        PluginError: the metric needs a card or an estimator that is not given.
    """

    full_state_update = False
    is_differentiable = False

    def __init__(
        self,
        metric: Metric,
        card: EnvironmentCard | None = None,
        estimator: StateEstimator | None = None,
    ) -> None:
        super().__init__()
        self.metric, self.card, self.estimator = metric, card, estimator
        reason = metric.unavailable(card, estimator) if card else None
        if metric.reads == "states" and card is None:
            reason = "it reads states, so it needs card and estimator"
        if reason:
            raise PluginError(f"{metric.name} cannot be measured: {reason}")
        for name in ("scores", "weights"):
            cast(Any, self).add_state(name, default=[], dist_reduce_fx="cat")

    scores: list[Tensor]
    weights: list[Tensor]

    @property
    def higher_is_better(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether higher values are better."""
        return self.metric.higher_is_better

    def update(
        self,
        prediction: Video | Clip,
        target: Video | Clip,
        episodes: Sequence[Episode] | None = None,
    ) -> None:
        """Score a batch of clips, or one clip.

        Args:
            prediction: `[B, T, 3, H, W]` or `[T, 3, H, W]`, in [0, 1].
            target: the true clips, like `prediction`.
            episodes: the true episode of each clip, for metrics that read states.

        Raises:
            ShapeError: the two differ in shape, or there is not one episode per clip, or frames are
                not float in [0, 1].
            PluginError: the metric cannot be measured on such frames.
        """
        for clip in (prediction, target):
            check_pixels(clip)
        pairs = [clip if clip.ndim == 5 else clip[None] for clip in (prediction, target)]
        known = [None] * len(pairs[1]) if episodes is None else episodes
        if not len(pairs[0]) == len(pairs[1]) == len(known):
            raise ShapeError(
                f"{len(pairs[0])} predicted clips, {len(pairs[1])} true ones and {len(known)} "
                "episodes"
            )
        card = self.card or _card(pairs[1])
        if not self.card and (reason := self.metric.unavailable(card, None)):
            raise PluginError(f"{self.metric.name} cannot be measured: {reason}")
        for predicted, true, episode in zip(*pairs, known, strict=True):
            if episode is None:
                self._add(_of_pixels(predicted, true, card))
            else:
                self._add(Prediction.of(episode, predicted, true, card, self.estimator))

    def compute(self) -> Tensor:
        """The score of all clips together, a scalar; NaN if no clip has a score."""
        scores, weights = (
            dim_zero_cat(cast(Any, each)).cpu().double().numpy() if len(each) else np.zeros(0)
            for each in (self.scores, self.weights)
        )
        if not weights.sum() > 0:
            return torch.tensor(torch.nan, device=self.device)
        if isinstance(self.metric, SetMetric):
            value = self.metric.distance_of([*scores])
        else:
            value = self.metric.summed_up(scores, weights)
        return torch.tensor(value, device=self.device)

    def _add(self, prediction: Prediction) -> None:
        with torch.autocast(prediction.target.device.type, enabled=False):
            if isinstance(self.metric, SetMetric):
                score, weight = self.metric.features(prediction), 1.0
            else:
                score, weight = self.metric.scored(prediction)
                if np.isnan(score):
                    return
        # Apple's GPUs do not support double precision.
        dtype = torch.float32 if self.device.type == "mps" else torch.float64
        for state, value in ((self.scores, score), (self.weights, weight)):
            state.append(torch.as_tensor(value, dtype=dtype, device=self.device)[None])


def _class(target: str) -> type[torchmetrics.Metric]:
    module, _, name = target.rpartition(".")
    if not module:
        raise RecipeError("name a class of torchmetrics, as in torchmetrics.image.CLASS")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise RecipeError(
            f"{target} is not available: it does not exist or needs a package that is "
            f"not installed ({_one_line(error)})"
        ) from error
    if not (isinstance(found, type) and issubclass(found, torchmetrics.Metric)):
        raise RecipeError(f"{target} is not a metric of torchmetrics")
    return found


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def _of_pixels(prediction: Clip, target: Clip, card: EnvironmentCard) -> Prediction:
    """A prediction of which only the pixels are known."""
    frames, _, height, width = target.shape
    actions, masks = np.zeros((frames, 1), np.float32), np.zeros((frames, height, width), np.uint8)
    return Prediction(prediction, target, actions, {}, masks, np.zeros((0, 3), np.int32), card)


def _card(video: Video) -> EnvironmentCard:
    """The card of an environment of which only the frame size is known."""
    action = ActionSpec(("action",), ("",), (-1.0,), (1.0,), "absolute")
    size = video.shape[-2], video.shape[-1]
    return EnvironmentCard(
        name="video",
        summary="",
        action=action,
        frame_size=size,
        fps=1,
        horizon=video.shape[1],
        factors=(),
        ood_shifts=(),
        state=(),
        instances=("unlabelled",),
        engine="recorded",
    )
