"""Metrics that judge the draws of a clip together: are they as different as the world is open?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from acwm_core.env.physics import Physics, Reading
from acwm_core.evaluation.metric import Metric, Numbers, Prediction
from acwm_metrics.physical import PhysicalMetric, physics_of, row_means
from acwm_metrics.seen import exist, held_of, share_found

DRAWS = "Draws"
"""The heading above these metrics in tables."""


class EnergyScore(Metric):
    """The energy score of the draws' frames (Gneiting & Raftery 2007, section 4.3).

    The mean distance of a draw to the truth, minus half the mean distance of two draws to each
    other. The distance of two frames is their root mean square difference over pixels and channels:
    the Euclidean distance, relative to that of black and white. The score is lowest, in the mean,
    for draws of the true distribution. Pairs of a draw with itself do not count, so that the mean
    score is the same for any number of draws (Ferro 2014). Of a single prediction it is the
    distance to the truth.
    """

    name = "energy_score"
    of_draws = True
    bounds = (-1.0, 1.0)
    group = DRAWS
    reads = "pixels"
    factor = 1000.0

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The score of each frame, `[T]`."""
        videos = _videos(prediction)
        target = _frames(prediction)
        away = np.mean([_distances(video, target) for video in videos], 0)
        apart = [_distances(*pair) for pair in itertools.combinations(videos, 2)]
        return away - np.mean(apart, 0) / 2 if apart else away


class SpreadSkill(Metric):
    """The spread of the draws relative to the error of their mean frames.

    The root of the variance over draws, times 1 + 1/N for N draws, over the root mean square error
    of their mean, both over pixels and channels (Fortin et al. 2014). It is 1 if the truth could be
    one of the draws, lower if they are too sure, and 0 for a model that draws none. What the codec
    loses counts as an error that no draw covers.
    """

    name = "spread_skill"
    title = "Spread to error"
    of_draws = True
    higher_is_better = True
    right = 1.0
    bounds = (0.0, math.inf)
    group = DRAWS
    reads = "pixels"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The ratio of each frame, `[T]`; NaN where the mean is exact, or without draws."""
        return np.sqrt(_ratio(*_moments(prediction)))

    def value(self, prediction: Prediction) -> float:
        """The ratio of the clip, of the means over its frames."""
        return float(np.sqrt(_ratio(*_moments(prediction).mean(1, keepdims=True)))[0])

    def weight(self, prediction: Prediction) -> float:
        """The clip's squared error, so that the summary is the ratio of the means over clips."""
        return float(np.nan_to_num(_moments(prediction)[1].mean()))

    def summarise(self, values: Numbers, weights: Numbers | None = None) -> float:
        """The ratio of many clips, of the means over all of them."""
        return float(np.sqrt(np.average(np.square(values), weights=weights)))


class _Coverage(PhysicalMetric):
    """How often the interval of the draws covers the true position of a body.

    The interval of each coordinate, in m, is that of a further draw where draws are normally
    distributed: their mean ± t·s·√(1 + 1/N) for N draws with the standard deviation s and Student's
    t of N − 1 degrees of freedom. Its share of cover is right if it is the interval's own. A body
    that is not found in a draw is where it was last seen. A model that draws none covers only what
    it hits exactly.
    """

    share: float
    of_draws = True
    higher_is_better = True
    bounds = (0.0, 1.0)
    group = DRAWS

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.positions else "no position that is read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The share of covered coordinates, `[T]`; NaN in the given frame, or without draws."""
        if not prediction.draws:
            return np.full(len(prediction.target), np.nan)
        readings = physics_of(prediction).positions
        covered = np.concatenate([self._covered(prediction, each) for each in readings], 1)
        covered[0] = np.nan
        return row_means(covered)

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the bodies and frames in which a place is found, in the mean over draws."""
        readings = physics_of(prediction).positions
        found = [share_found(draw, readings) for draw in prediction.draws]
        return float(np.mean(found)) if found else float("nan")

    def _covered(self, prediction: Prediction, reading: Reading) -> NDArray[np.float64]:
        """Whether each coordinate is covered, `[T, n]`; NaN where it is not known in all draws."""
        true = reading.of(prediction.states)
        seen = np.stack([_positions(draw, reading) for draw in prediction.draws])
        number = len(seen)
        reach = np.zeros(true.shape)
        if number > 1:
            quantile = stats.t.ppf((1 + self.share) / 2, number - 1)
            reach = quantile * seen.std(0, ddof=1) * math.sqrt(1 + 1 / number)
        away = np.abs(seen.mean(0) - true)
        covered = np.where(np.isfinite(away), away <= reach, np.nan)
        if reading.present:
            covered[~exist(prediction, reading)] = np.nan
        return covered.reshape(len(covered), -1)


class Coverage50(_Coverage):
    """Coverage by the interval that should hold half of all true positions."""

    name, title = "coverage_50", "In the 50 % interval"
    share = right = 0.5


class Coverage80(_Coverage):
    """Coverage by the interval that should hold 80 % of all true positions."""

    name, title = "coverage_80", "In the 80 % interval"
    share = right = 0.8


class Coverage95(_Coverage):
    """Coverage by the interval that should hold 95 % of all true positions."""

    name, title = "coverage_95", "In the 95 % interval"
    share = right = 0.95


def _positions(draw: Prediction, reading: Reading) -> NDArray[np.float64]:
    """Positions as a draw shows them; the points of a curve from the end that fits the truth."""
    seen, true = reading.of(held_of(draw).states), reading.of(draw.states)
    if reading.kind != "curve":
        return seen
    ways = [np.linalg.norm(each - true, axis=-1).mean(1) for each in (seen, seen[:, ::-1])]
    return np.where((ways[0] <= ways[1])[:, None, None], seen, seen[:, ::-1])


def _moments(prediction: Prediction) -> NDArray[np.float64]:
    """Variance over draws and squared error of their mean in each frame, `[2, T]`.

    NaN if the prediction has no draws.
    """
    return prediction.once(_moments, lambda: _measured_moments(prediction))


def _measured_moments(prediction: Prediction) -> NDArray[np.float64]:
    if not prediction.draws:
        return np.full((2, len(prediction.target)), np.nan)
    videos, number = _videos(prediction), len(prediction.draws)
    mean = sum(videos[1:], videos[0]) / number
    error = np.square(mean - _frames(prediction)).mean(1, dtype=np.float64)
    if number == 1:
        return np.stack([np.zeros_like(error), error])
    squares = [np.square(video - mean).mean(1, dtype=np.float64) for video in videos]
    return np.stack([np.sum(squares, 0) / (number - 1) * (1 + 1 / number), error])


def _ratio(spread: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.divide(spread, error, out=np.full(len(error), np.nan), where=error > 0)


def _videos(prediction: Prediction) -> Sequence[NDArray[np.float32]]:
    draws = prediction.draws or (prediction,)
    return [draw.video.flatten(1).numpy() for draw in draws]


def _frames(prediction: Prediction) -> NDArray[np.float32]:
    return prediction.target.flatten(1).numpy()


def _distances(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.float64]:
    """Root mean square differences of frames `[T, D]`, `[T]`."""
    return np.sqrt(np.square(one - other).mean(1, dtype=np.float64))
