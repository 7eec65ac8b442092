"""Every check of estimators can fail; that those of the worlds conform, test_environments tells."""

from dataclasses import replace

import numpy as np
import pytest

from acwm_core.checks import check_estimator
from acwm_core.checks.disc import RADIUS, Disc, DiscEstimator
from acwm_core.checks.estimator import EstimatorChecks
from acwm_core.checks.result import checks_of
from acwm_core.env.physics import Physics, Reading
from tests.checks.results import Flaws, failures

FLAWS = Flaws(check_estimator, checks_of(EstimatorChecks), Disc)


class Misplaced(DiscEstimator):
    """Reads other positions than it should."""

    def estimate(self, video):
        seen = super().estimate(video)
        return replace(seen, states={**seen.states, "position": self.off(seen.states["position"])})


def test_a_sound_estimator_passes():
    assert failures(check_estimator(DiscEstimator, Disc)) == {}
    assert RADIUS > 0.05  # so that it has more than 20 pixels, and its mask is checked


@FLAWS.caught_by("reads a clip", "not (24, 64, 96)")
class OneMask(DiscEstimator):
    def estimate(self, video):
        seen = super().estimate(video)
        return replace(seen, masks=seen.masks[:1])


@FLAWS.caught_by("reads a clip", "is infinite")
class Infinite(Misplaced):
    def off(self, position):
        return position / 0


@FLAWS.caught_by("says what it reads", "lists the fields")
class SaysMore(DiscEstimator):
    fields = ("position", "bearing", "velocity")


@FLAWS.caught_by("says what it reads", "which is not read")
class NeedsMore(DiscEstimator):
    @property
    def physics(self):
        return Physics(readings=(Reading("velocity", "position", ("disc",)),))


@FLAWS.caught_by("tells instances apart", "'disc' have an IoU of")
class SeesShadows(DiscEstimator):
    def estimate(self, video):
        seen = super().estimate(video)
        return replace(seen, masks=np.roll(seen.masks, 12, axis=2))


@FLAWS.caught_by("follows what moves", "is off by")
class Sluggish(Misplaced):
    def off(self, position):
        return np.zeros_like(position) + 0.3


@FLAWS.caught_by("shows positions in the frame", "far outside the frame")
class WrongScale(DiscEstimator):
    def pixels(self, field, values):
        return 10 * super().pixels(field, values)


@FLAWS.caught_by("reads frames of every size", "not of the card's size")
class ReadsAnything(DiscEstimator):
    def estimate(self, video):
        height, width = video.shape[2:]
        return DiscEstimator(replace(self.card, frame_size=(height, width))).estimate(video)


@FLAWS.caught_by("reading repeats and leaves no trace", "changes its input")
class InPlace(DiscEstimator):
    def estimate(self, video):
        seen = super().estimate(video)
        video.mul_(0.99)
        return seen


@FLAWS.caught_by("reading repeats and leaves no trace", "second reading of 'position'")
class Random(Misplaced):
    def off(self, position):
        return position + 1e-3 * np.random.default_rng().random()


def test_a_class_needs_an_environment():
    with pytest.raises(ValueError, match="which environment"):
        check_estimator(DiscEstimator)
