"""Every installed metric conforms, and every check of metrics can fail."""

import numpy as np
import pytest

from acwm_core.checks import check_metric
from acwm_core.checks.metric import CHECKS
from acwm_core.metric import Metric
from tests.checks.results import Flaws, failures, in_words, installed

FLAWS = Flaws()


class Distance(Metric):
    """Mean absolute difference."""

    name = "distance"

    def per_frame(self, rollout):
        error = (rollout.prediction - rollout.target).abs()
        return error.mean((1, 2, 3)).double().numpy()


@pytest.mark.parametrize("part", installed("metric"), ids=lambda part: part.name)
def test_installed_metrics_conform(part):
    assert failures(check_metric(part.name)) == {}


def test_a_sound_metric_passes():
    assert failures(check_metric(Distance)) == {}


@FLAWS.caught_by("scores a clip", "scores")
class ForgetsTheFirst(Distance):
    def per_frame(self, rollout):
        return super().per_frame(rollout)[1:]


@FLAWS.caught_by("scores a clip", "no frame of a noisy prediction")
class NeverDefined(Distance):
    def per_frame(self, rollout):
        return np.full(len(rollout.target), np.nan)

    def value(self, rollout):
        return 1.0


@FLAWS.caught_by("says what it is", "empty")
class Nameless(Distance):
    name = ""


@FLAWS.caught_by("truth scores best", "the true video scores 0,")
class WrongDirection(Distance):
    higher_is_better = True


@FLAWS.caught_by("more noise is no better", "with growing noise")
class Saturates(Distance):
    def value(self, rollout):
        error = super().value(rollout)
        return error if error < 0.1 else 0.1 + 0.01 / error


@FLAWS.caught_by("scoring repeats and leaves no trace", "changes the video")
class InPlace(Distance):
    def per_frame(self, rollout):
        rollout.prediction.mul_(0.999)
        return np.ones(len(rollout.target))


@FLAWS.caught_by("scoring repeats and leaves no trace", "second scoring")
class Random(Distance):
    def per_frame(self, rollout):
        return super().per_frame(rollout) + np.random.default_rng().random()


@FLAWS.caught_by("summary of equals is their value", "three times")
class Sums(Distance):
    def summarise(self, values, weights=None):
        return float(np.sum(values))


@pytest.mark.parametrize("flawed", FLAWS, ids=lambda flawed: flawed.__name__)
def test_flaws_are_found(flawed):
    check, reason = FLAWS[flawed]
    assert reason in failures(check_metric(flawed))[check]


def test_every_check_has_a_flaw_that_it_finds():
    assert FLAWS.checks() == {in_words(check) for check in CHECKS}
