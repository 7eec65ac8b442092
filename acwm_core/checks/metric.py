"""Checks of a metric: what evaluation and reports require of it."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.checks.disc import Disc, DiscEstimator
from acwm_core.checks.result import Checked, CheckResult, Suite, expect, expect_is_a
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.evaluation.metric import Metric, Prediction, Reads, SetMetric
from acwm_core.evaluation.score import estimator_for
from acwm_core.model.shapes import Clip
from acwm_core.plugins import catalog


class MetricChecks(Suite):
    """Checks of every `acwm_core.evaluation.metric.Metric` on a clip with good and bad predictions.

    Args:
        component: a registered name, or the class.
        environment: the environment of the clip, a registered name or a class. By default the first
            one on which the metric can be measured: from the metric's own plugin, else a moving
            disc, else any other.
        **params: constructor parameters.
    """

    kind = "metric"

    def __init__(
        self, component: Checked, environment: Checked | None = None, **params: Any
    ) -> None:
        super().__init__(component, **params)
        self._given = environment

    @functools.cached_property
    def _environment(self) -> EnvironmentTrial:
        if self._given:
            return EnvironmentTrial(self._given)
        metrics, known = (catalog().registry(kind) for kind in ("metric", "environment"))
        plugin = metrics[self.name].plugin if self.name else None
        installed = [component for component in known if not component.missing_modules()]
        own = [component.name for component in installed if component.plugin == plugin]
        others = [component.name for component in installed if component.plugin != plugin]
        for tried in (*own, Disc, *others):
            with contextlib.suppress(Exception):  # skip environments that do not work
                trial = EnvironmentTrial(tried)
                if self._metric.unavailable(trial.card, _estimator_of(trial.card)) is None:
                    return trial
        return EnvironmentTrial(Disc)

    @classmethod
    def check(cls, component: Checked, *args: Any, **params: Any) -> Iterator[CheckResult]:
        """As for every suite; metrics of sets and of draws have partly different checks."""
        if cls is not MetricChecks:
            return super().check(component, *args, **params)
        target: Any = cls(component).target
        of_sets = isinstance(target, type) and issubclass(target, SetMetric)
        of_draws = cast(Any, target).of_draws if isinstance(target, type) else False
        suite = SetMetricChecks if of_sets else DrawsMetricChecks if of_draws else ClipMetricChecks
        return suite.check(component, *args, **params)

    @functools.cached_property
    def _metric(self) -> Any:
        return self.make()

    def _raw_scores(self, prediction: Prediction) -> NDArray[Any]:
        return self._metric.per_frame(prediction)

    def _score(self, prediction: Prediction) -> float:
        return self._metric.value(prediction)

    @property
    def _reads_pixels(self) -> bool:
        """Whether the metric works without an estimator."""
        return self._metric.unavailable(self._environment.card, None) is None

    @functools.cached_property
    def _estimator(self) -> StateEstimator | None:
        return _estimator_of(self._environment.card)

    @functools.cached_property
    def _perfect(self) -> Prediction:
        """The first frames of an episode and of a branch of it, predicted without error."""
        actions = self._environment.episode.actions[:24]
        backwards = np.concatenate([actions[-2::-1], actions[-1:]])
        clip, branch = map(self._simulated, (actions, backwards))
        return replace(clip, branches=(branch,))

    def _simulated(self, actions: NDArray[np.float32]) -> Prediction:
        trial = self._environment
        episode = simulate(trial.environment, trial.spec(), actions, frames=len(actions))
        truth = Prediction.truth(episode, trial.card, self._estimator)
        return replace(truth, video=truth.target.clone())

    def _predicted(self, predict: Callable[[Clip], Clip]) -> Prediction:
        """The same clip and branch, with predictions computed from the truth by `predict`."""
        clip, branches = self._perfect, self._perfect.branches
        others = (replace(branch, video=predict(branch.target)) for branch in branches)
        return replace(clip, video=predict(clip.target), branches=tuple(others))

    def _noisy(self, amount: float, seed: int = 0) -> Prediction:
        """Predictions with Gaussian noise of this standard deviation on all but the first frame."""
        generator = torch.Generator().manual_seed(seed)

        def predict(target: Clip) -> Clip:
            noise = torch.randn(target.shape, generator=generator) * amount
            noise[0] = 0
            return (target + noise).clamp(0, 1)

        return self._predicted(predict)

    def _to_be_scored(self, base: type[Metric]) -> Prediction:
        expect_is_a(self._metric, base)
        prediction = self._noisy(0.1)
        reason = self._metric.unavailable(prediction.card, prediction.estimator)
        expect(reason is None, f"it cannot be measured here: {reason}")
        value = self._score(prediction)
        expect(math.isfinite(value), f"a noisy prediction scores {value}")
        return prediction

    def says_what_it_is(self) -> None:
        """Have the registered name, and everything that tables need."""
        metric = self._metric
        expect(self.name in (None, metric.name), f"its name is {metric.name!r}")
        expect(metric.name, "its name is empty")
        for text in (metric.name, metric.title, metric.unit, metric.group):
            expect_is_a(text, str)
        expect_is_a(metric.higher_is_better, bool)
        known = get_args(Reads)
        expect(metric.reads in known, f"it reads {metric.reads!r}, which is none of {known}")

    def scoring_repeats_and_leaves_no_trace(self) -> None:
        """Give the same scores twice, without changing the inputs."""
        prediction = self._noisy(0.1)
        video, target = prediction.video.clone(), prediction.target.clone()
        states = {name: values.copy() for name, values in prediction.states.items()}
        first, second = (self._raw_scores(prediction) for _ in range(2))
        expect(np.array_equal(first, second, equal_nan=True), "a second scoring differs")
        same = torch.equal(video, prediction.video) and torch.equal(target, prediction.target)
        expect(same, "it changes its input video")
        for name, values in states.items():
            same = np.array_equal(values, prediction.states[name], equal_nan=True)
            expect(same, f"it changes state {name!r}")


class _ValueChecks(MetricChecks):
    """Checks of a metric in which each clip has a score."""

    def scores_a_clip(self) -> None:
        """Construct the metric and score a clip, frame by frame and as a whole."""
        prediction = self._to_be_scored(Metric)
        scores, frames = self._metric.per_frame(prediction), len(prediction.target)
        expect(np.shape(scores) == (frames,), f"{frames} frames got {np.shape(scores)} scores")
        expect(np.isfinite(scores).any(), "no frame of a noisy prediction gets a finite score")
        (low, high), value = self._metric.bounds, self._metric.value(prediction)
        expect(low <= value <= high, f"the score {value:.4g} is outside its bounds {low} to {high}")

    def summary_of_equals_is_their_value(self) -> None:
        """Summarise equal values as that value."""
        prediction = self._noisy(0.1)
        value, weight = self._metric.value(prediction), self._metric.weight(prediction)
        summary = self._metric.summarise([value] * 3, [weight] * 3)
        same = math.isclose(summary, value, rel_tol=1e-6)
        expect(same, f"three times {value:.4g} is {summary:.4g}")


class _DrawChecks(MetricChecks):
    """Checks of a metric on several draws of a clip."""

    def _noisy(self, amount: float, seed: int = 0) -> Prediction:
        draws = [super(_DrawChecks, self)._noisy(amount, seed + draw) for draw in range(4)]
        return replace(draws[0], draws=tuple(draws))

    def draws_have_no_order(self) -> None:
        """Score draws the same in any order, and otherwise than the first of them alone."""
        prediction = self._noisy(0.1)
        value = self._score(prediction)
        turned = replace(prediction, draws=prediction.draws[::-1])
        same = math.isclose(value, self._score(turned), rel_tol=1e-5)
        expect(same, "the order of the draws matters")
        alone = self._score(replace(prediction, draws=prediction.draws[:1]))
        expect(value != alone, "it looks at one draw only")


class DrawsMetricChecks(_ValueChecks, _DrawChecks):
    """Checks of a metric that judges the draws of a clip together."""


class _OrderChecks(MetricChecks):
    """Checks of a metric that says which of two predictions is better."""

    def _is_better(self, value: float, best: float) -> bool:
        """Whether a bad prediction scores better than the true video."""
        if self._metric.higher_is_better:
            return value > best
        return value < (best if self._reads_pixels else best / 2)  # estimator errors vary

    def truth_scores_best(self) -> None:
        """Score no bad prediction better than the true video, and some worse; equal sets score 0.

        Which ones are worse depends on the metric: a still scene breaks no conservation law.
        Undefined scores are not compared.
        """
        best = self._score(self._perfect)
        expect(not math.isnan(best), "the true video gets no score")
        flawed = {
            "noise": self._noisy(0.5),
            "a still first frame": self._predicted(lambda c: c[:1].expand_as(c).clone()),
            "an empty scene": self._predicted(_emptied),
            "a shifted picture": self._predicted(lambda c: c.roll(c.shape[-1] // 4, -1)),
            "a late video": self._predicted(lambda c: torch.cat([c[:1], c[:1], c[:-2]])),
            "a video that runs backwards": self._predicted(lambda c: c.flip(0)),
        }
        values = {name: self._score(prediction) for name, prediction in flawed.items()}
        for name, value in values.items():
            better = self._is_better(value, best)
            expect(not better, f"the true video scores {best:.4g}, {name} scores {value:.4g}")
        sign = -1 if self._metric.higher_is_better else 1
        worse = any(sign * (value - best) > 0 for value in values.values())
        expect(worse, f"{', '.join(values)}: none scores worse than the true video's {best:.4g}")
        if isinstance(self._metric, SetMetric):
            expect(best < 1e-3 * values["noise"], f"equal sets score {best:.4g}, not 0")

    def more_noise_is_no_better(self) -> None:
        """Never improve as the prediction gets noisier.

        How an estimator reacts to noise is not specified, so metrics that need one must only score
        noise no better than the true video.
        """
        values = [self._score(self._noisy(amount)) for amount in (0.0, 0.1, 0.3, 1.0)]
        in_order = values == sorted(values, reverse=self._metric.higher_is_better)
        if not self._reads_pixels:
            in_order = not any(self._is_better(value, values[0]) for value in values)
        listed = ", ".join(f"{value:.4g}" for value in values)
        expect(in_order, f"with growing noise it goes {listed}")


class ClipMetricChecks(_ValueChecks, _OrderChecks):
    """Checks of a metric that scores each clip."""


class SetMetricChecks(_OrderChecks):
    """Checks of a metric that compares sets of clips, on sideways shifts of one clip."""

    def _raw_scores(self, prediction: Prediction) -> NDArray[Any]:
        return self._metric.features(prediction)

    def _score(self, prediction: Prediction) -> float:
        width = prediction.target.shape[-1]
        pairs = prediction.video, prediction.target
        moved = ([clip.roll(width * quarter // 4, -1) for clip in pairs] for quarter in range(4))
        clips = (replace(prediction, video=video, target=true) for video, true in moved)
        return self._metric.distance(np.stack([self._metric.features(clip) for clip in clips]))

    def scores_a_set(self) -> None:
        """Construct the metric, turn clips into vectors and score a set of them."""
        expect_is_a(self._metric, SetMetric)
        shape = np.shape(self._metric.features(self._noisy(0.1)))
        expect(len(shape) == 2 and shape[0] == 2, f"features of a clip are {shape}, not (2, D)")
        prediction = self._to_be_scored(SetMetric)
        expect(np.isnan(self._metric.per_frame(prediction)).all(), "a clip has a score of its own")


def _estimator_of(card: EnvironmentCard) -> StateEstimator | None:
    return DiscEstimator(card) if card.name == Disc.card.name else estimator_for(card)


def _emptied(target: Clip) -> Clip:
    """The first half, then frames filled with the colour of the upper left corner."""
    half = len(target) // 2
    return torch.cat([target[:half], target[half:, :, :1, :1].expand_as(target[half:])])
