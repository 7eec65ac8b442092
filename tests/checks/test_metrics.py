"""Every installed metric conforms, and every check of metrics can fail."""

import numpy as np
import pytest

from acwm_core.checks import check_metric
from acwm_core.checks.metric import ClipMetricChecks, DrawsMetricChecks, SetMetricChecks
from acwm_core.checks.result import checks_of
from acwm_core.evaluation.metric import Metric, SetMetric
from tests.checks.results import Flaws, failures, installed

FLAWS, SET_FLAWS, DRAWS_FLAWS = (
    Flaws(check_metric, checks_of(suite))
    for suite in (ClipMetricChecks, SetMetricChecks, DrawsMetricChecks)
)


class Distance(Metric):
    """Mean absolute difference."""

    name = "distance"

    def per_frame(self, prediction):
        error = (prediction.video - prediction.target).abs()
        return error.mean((1, 2, 3)).double().numpy()


NEED_PARAMETERS = ("lpips", "fvd", "torchmetrics")
"""Checked with weights of their own, or by classes of the library, in tests/metrics."""


@pytest.mark.parametrize(
    "name", sorted({each.name for each in installed("metric")}.difference(NEED_PARAMETERS))
)
def test_installed_metrics_conform(name):
    assert failures(check_metric(name)) == {}


def test_a_sound_metric_passes():
    assert failures(check_metric(Distance)) == {}


@FLAWS.caught_by("scores a clip", "scores")
class ForgetsTheFirst(Distance):
    def per_frame(self, prediction):
        return super().per_frame(prediction)[1:]


@FLAWS.caught_by("scores a clip", "outside its bounds -1 to 0")
class LeavesItsBounds(Distance):
    bounds = (-1, 0)


@FLAWS.caught_by("scores a clip", "no frame of a noisy prediction")
class NeverDefined(Distance):
    def per_frame(self, prediction):
        return np.full(len(prediction.target), np.nan)

    def value(self, prediction):
        return 1.0


@FLAWS.caught_by("says what it is", "empty")
class Nameless(Distance):
    name = ""


@FLAWS.caught_by("says what it is", "it reads 'sound'")
class ReadsSomethingElse(Distance):
    reads = "sound"


@FLAWS.caught_by("truth scores best", "the true video scores 0,")
class WrongDirection(Distance):
    higher_is_better = True


@FLAWS.caught_by("more noise is no better", "with growing noise")
class Saturates(Distance):
    def value(self, prediction):
        error = super().value(prediction)
        return error if error < 0.1 else 0.1 + 0.01 / error


@FLAWS.caught_by("scoring repeats and leaves no trace", "changes its input")
class InPlace(Distance):
    def per_frame(self, prediction):
        prediction.video.mul_(0.999)
        return np.ones(len(prediction.target))


@FLAWS.caught_by("scoring repeats and leaves no trace", "second scoring")
class Random(Distance):
    def per_frame(self, prediction):
        return super().per_frame(prediction) + np.random.default_rng().random()


@FLAWS.caught_by("summary of equals is their value", "three times")
class Sums(Distance):
    def summarise(self, values, weights=None):
        return float(np.sum(values))


class Change(SetMetric):
    """Distance of the sets' mean change from frame to frame."""

    name = "change"

    def features(self, prediction):
        clips = (prediction.video, prediction.target)
        return np.stack([c.diff(dim=0).abs().mean((0, 1)).flatten().numpy() for c in clips])

    def distance(self, features):
        made, true = features.mean(0)
        return float(((made - true) ** 2).sum())


def test_a_sound_metric_of_sets_passes():
    assert failures(check_metric(Change)) == {}


@SET_FLAWS.caught_by("scores a set", "not (2, D)")
class OneVector(Change):
    def features(self, prediction):
        return super().features(prediction)[0]


@SET_FLAWS.caught_by("says what it is", "empty")
class NamelessSet(Change):
    name = ""


@SET_FLAWS.caught_by("truth scores best", "equal sets score 1")
class NeverZero(Change):
    def distance(self, features):
        return 1 + super().distance(features)


@SET_FLAWS.caught_by("more noise is no better", "with growing noise")
class Inverse(Change):
    def distance(self, features):
        distance = super().distance(features)
        return 1 / distance if distance else 0.0


@SET_FLAWS.caught_by("scoring repeats and leaves no trace", "second scoring")
class RandomSet(Change):
    def features(self, prediction):
        return super().features(prediction) + 1e-9 * np.random.default_rng().random()


class Apart(Metric):
    """How far the draws are from their mean."""

    name = "apart"
    of_draws = True

    def per_frame(self, prediction):
        videos = np.stack([draw.video.numpy() for draw in prediction.draws])
        return videos.std(0).mean((1, 2, 3), dtype=np.float64)


def test_a_sound_metric_of_draws_passes():
    assert failures(check_metric(Apart)) == {}


@DRAWS_FLAWS.caught_by("draws have no order", "the order of the draws matters")
class WeighsDraws(Apart):
    def per_frame(self, prediction):
        return super().per_frame(prediction) + prediction.draws[0].video.mean((1, 2, 3)).numpy()


@DRAWS_FLAWS.caught_by("draws have no order", "one draw only")
class ForgetsDraws(Distance):
    of_draws = True


@DRAWS_FLAWS.caught_by("says what it is", "empty")
class NamelessOfDraws(Apart):
    name = ""


@DRAWS_FLAWS.caught_by("scores a clip", "scores")
class ForgetsAFrame(Apart):
    def per_frame(self, prediction):
        return super().per_frame(prediction)[1:]


@DRAWS_FLAWS.caught_by("scoring repeats and leaves no trace", "second scoring")
class RandomOfDraws(Apart):
    def per_frame(self, prediction):
        return super().per_frame(prediction) + np.random.default_rng().random()


@DRAWS_FLAWS.caught_by("summary of equals is their value", "three times")
class SumsOfDraws(Apart):
    def summarise(self, values, weights=None):
        return float(np.sum(values))
