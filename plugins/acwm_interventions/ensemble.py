"""The simulator's own ensemble: futures from starts that a picture hardly tells apart.

They are the truth about doubt. A model's draws are compared with them as a distribution, by the
energy distance (Székely & Rizzo 2013), which is 0 for equal distributions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import to_pixels
from acwm_core.env.environment import Environment
from acwm_core.env.episode import Episode
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import noting
from acwm_core.evaluation.clips import Clip, as_clip, read_clips
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Ensemble
from acwm_core.evaluation.statistics import ClipScores, Estimate, Values, finite
from acwm_interventions.simulations import Again, simulate_again

RESOLVED = 12**-0.5
"""Standard deviation, in pixels, of a place that is known up to the pixel in which it is."""

SMALL = 1e-3
"""A step in m by which positions are moved to measure the size of a pixel there."""

Places = NDArray[np.intp]
"""Which of all futures of a clip are those of a row."""

Pixels = NDArray[np.uint8]
"""A video `[T, H, W, 3]`, as all are held: there are many of each clip."""

Futures = Mapping[str, Sequence[Pixels]]
"""The futures of a clip by what makes them: ``simulator``, and rows of an evaluation."""


def compare_ensembles(
    evaluator: Evaluator,
    environment: Environment,
    clips: Sequence[Clip],
    episodes: EpisodeDataset,
) -> Ensemble:
    """Compare what the model draws of clips with the simulator's futures of them.

    Args:
        evaluator: predicts the clips, as many times as the settings ask for; its estimator knows
            how large a pixel is.
        environment: the simulator, which has perturbed starts.
        clips: clips that begin with their episode.
        episodes: their episodes.
    """
    assert evaluator.estimator is not None
    curves: dict[str, list[Values]] = {}
    spreads: dict[str, list[float]] = {}
    amounts: list[float] = []
    for clip, episode in read_clips(clips, episodes):
        amounts.append(start_doubt(episode, evaluator.estimator))
        truth = Prediction.truth(episode, evaluator.card, None, clip)
        starts = evaluator.config.ensemble_starts
        moved = Again(episode.spec, episode.actions, len(episode.video), amounts[-1])
        asked = [moved._replace(start=start) for start in range(1, starts + 1)]
        simulated = [each.video for each in simulate_again(environment, asked)]
        with noting(clip.where, *evaluator.world_model.children()):
            futures = _futures(evaluator, truth, simulated)
        seen = {name: [each[clip.given - 1 :] for each in of] for name, of in futures.items()}
        distances, spread = energy_distances(seen)
        for name, curve in distances.items():
            curves.setdefault(name, []).append(curve)
        for name, size in spread.items():
            spreads.setdefault(name, []).append(size)
        evaluator.advance(1)
    places = np.array([(clip.episode, clip.start) for clip in clips], np.int64)

    def estimates(values: Mapping[str, Sequence[float]]) -> dict[str, Estimate]:
        seed = evaluator.config.seed
        return {
            name: ClipScores(np.array(of), np.ones(len(of)), places).estimate(seed)
            for name, of in values.items()
        }

    return Ensemble(
        clips=len(clips),
        starts=evaluator.config.ensemble_starts,
        draws=max(evaluator.draws, 1),
        moved=float(np.mean(amounts)) * SMALL,
        distance=estimates({name: [each.mean() for each in of] for name, of in curves.items()}),
        spread=estimates(spreads),
        curves={name: _mean_curve(of) for name, of in curves.items()},
    )


def start_doubt(episode: Episode, estimator: StateEstimator) -> float:
    """How far a start is moved, as `Environment._perturb` counts it (1 is about a millimetre).

    So far that its positions have the standard deviation `RESOLVED`, in pixels of the video.
    """
    moves: list[NDArray[np.float64]] = []
    for reading in estimator.physics.positions:
        places = np.asarray(episode.states[reading.field][0], np.float64)
        steps = SMALL * np.eye(places.shape[-1])
        here, *there = (estimator.pixels(reading.field, places + step) for step in (0, *steps))
        seen = np.linalg.norm(np.stack(there) - here, axis=-1).max(0)  # in the best direction
        exists = np.asarray(episode.states[reading.present][0] if reading.present else 1) > 0
        moves.append(seen[np.broadcast_to(exists, seen.shape)].ravel())
    return float(RESOLVED / np.median(np.concatenate(moves)))


def _futures(evaluator: Evaluator, truth: Prediction, simulated: Sequence[Pixels]) -> Futures:
    """The simulator's futures, the model's, and what bounds the model's distance to them."""
    model, copy = evaluator.predict([truth], ["model", "copy"], draws=max(evaluator.draws, 1))
    found = {"simulator": simulated, "model": [to_pixels(draw.video) for draw in model.draws]}
    if "codec" in evaluator.rows:
        half = simulated[1::2]
        true = (replace(truth, target=as_clip(each)) for each in half)
        coded = (made for each in true for made in evaluator.predict([each], ["codec"]))
        found["codec"] = [to_pixels(made.video) for made in coded]
    return {**found, "copy": [to_pixels(copy.video)]}


def energy_distances(futures: Futures) -> tuple[dict[str, Values], dict[str, float]]:
    """Distances of all rows to the simulator in each frame, and how much their futures differ.

    The distance of two frames is the root mean square of their difference. The energy distance is
    twice the mean distance between the two sets minus those within each, over pairs of different
    futures, so it is 0 in the mean for any numbers of draws of one distribution, and sometimes
    below. The row ``simulator`` is every second of the simulator's futures against the others; the
    row ``codec`` has the reconstructions of the same.

    Returns:
        The distance of each row, `[T]`, and its mean distance of two futures, for rows with
        several of them.
    """
    matrix = _distances([video for of in futures.values() for video in of])
    places: dict[str, Places] = {}
    for name, of in futures.items():
        start = sum(map(len, places.values()))
        places[name] = np.arange(start, start + len(of))
    simulator = places["simulator"]
    first, second = simulator[::2], simulator[1::2]
    against = {"simulator": first, "codec": first}
    distances = {
        name: _energy_distance(matrix, against.get(name, simulator), place)
        for name, place in {**places, "simulator": second}.items()
    }
    several = {name: place for name, place in places.items() if len(place) > 1}
    return distances, {name: float(_within(matrix, p).mean()) for name, p in several.items()}


def _energy_distance(matrix: Values, one: Places, other: Places) -> Values:
    between = matrix[:, one][:, :, other].mean((1, 2))
    return 2 * between - _within(matrix, one) - _within(matrix, other)


def _within(matrix: Values, place: Places) -> Values:
    """The mean distance of two different futures, `[T]`; 0 if there is only one."""
    number = len(place)
    return matrix[:, place][:, :, place].sum((1, 2)) / max(number * (number - 1), 1)


def _distances(videos: Sequence[Pixels]) -> Values:
    """Root mean square differences of the frames of all pairs of K videos, `[T, K, K]`."""
    found: list[Values] = []
    for frames in zip(*videos, strict=True):
        rows = torch.as_tensor(np.stack(frames)).flatten(1).float() / 255
        apart = torch.cdist(rows, rows, compute_mode="donot_use_mm_for_euclid_dist")
        found.append(apart.double().numpy() / rows.shape[1] ** 0.5)
    return np.stack(found)


def _mean_curve(curves: Sequence[Values]) -> list[float | None]:
    """The mean over clips of each frame, as far as the longest one goes."""
    table = np.full((len(curves), max(map(len, curves))), np.nan)
    for row, curve in zip(table, curves, strict=True):
        row[: len(curve)] = curve
    return [finite(float(np.nanmean(frame))) for frame in table.T]
