"""Calibrates thresholds on true videos: ``python -m acwm_metrics.calibrate DATA… --out FILE``.

True videos obey physics, so any violation that an estimator reads in them is its own error, and
their contacts are known. So each tolerance is set above the largest lasting error. Each distance at
which bodies count as touching is set where the detected contacts best match the true ones.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Split
from acwm_core.env.physics import Gap
from acwm_core.evaluation.metric import Prediction
from acwm_core.plugins import catalog
from acwm_metrics.conservation import LASTING, change
from acwm_metrics.contact import beginnings, matched, true_contacts
from acwm_metrics.physical import physics_of
from acwm_metrics.presence import out_of_sight, seen_once
from acwm_metrics.seen import measured

MARGIN = 1.2
"""Factor between a tolerance and the largest error on the calibration videos."""

WIDE_MARGIN = 1.7
"""The factor for quantities that differ most between scenes: lengths, amounts, and how long an
object is missed or seen in pieces. With 1.2, four of 100 other videos of `pour_water` seemed to
lose water, and two of eight of `cloth_move` seemed to lose a cloth or sphere."""

LEFT_OUT = 1 / 200
"""Share of these videos that may exceed it: in a few, conserved things really leave the view."""

MIN_TOLERANCE = {"solid": 0.015, "constant": 0.05}
"""The smallest tolerances (in m, and relative) for estimators with very small errors: one of 24
other videos had a link 3 % too short, and one of 100 had cubes that overlap by 12 mm, a little more
than the calibration videos suggested."""

Signal = NDArray[np.float64]


def calibrate(predictions: Sequence[Prediction]) -> dict[str, float]:
    """Compute the limits of an environment, by name.

    Args:
        predictions: true videos, used as predictions of themselves.
    """
    physics = physics_of(predictions[0])
    limits = {
        each.name: WIDE_MARGIN
        * worst([largest_lasting(np.abs(change(each, r)), each.lasting) for r in predictions])
        for each in physics.constants
    }
    limits = {name: max(value, MIN_TOLERANCE["constant"]) for name, value in limits.items()}
    if physics.objects:
        longest = worst([longest_run(~seen_once(r)) for r in predictions])
        limits["objects.lasting"] = max(LASTING, int(WIDE_MARGIN * longest) + 1)
        hidden = worst([max(map(longest_run, out_of_sight(r).T)) for r in predictions])
        limits["objects.unseen"] = max(LASTING, int(MARGIN * hidden) + 1)
    kinds: dict[str, list[Gap]] = defaultdict(list)
    for gap in physics.gaps:
        kinds[gap.name].append(gap)
    for name, gaps in kinds.items():
        pairs = [(measured(gap, r), true_contacts(r, gap)) for gap in gaps for r in predictions]
        if gaps[0].solid is not None:
            depths = np.reshape(
                [largest_lasting(-distance) for distance, _ in pairs], (len(gaps), -1)
            )
            limits[f"{name}.solid"] = max(MARGIN * worst(depths.max(0)), MIN_TOLERANCE["solid"])
        if gaps[0].touch is not None:
            limits[f"{name}.touch"] = best_touch(pairs)
    return {name: round(value, 5) for name, value in limits.items()}


def worst(errors: Sequence[float] | Signal) -> float:
    """The largest error of the clips, after leaving out the share `LEFT_OUT`."""
    return float(np.sort(errors)[-1 - round(LEFT_OUT * len(errors))])


def largest_lasting(values: Signal, frames: int = LASTING) -> float:
    """The largest value that is reached for `frames` frames in a row; −∞ if there are too few."""
    if len(values) < frames:
        return -np.inf
    filled = np.where(np.isnan(values), -np.inf, values)
    return float(np.lib.stride_tricks.sliding_window_view(filled, frames).min(1).max())


def longest_run(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of True."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def best_touch(pairs: Sequence[tuple[Signal, NDArray[np.bool_]]]) -> float:
    """The threshold of distance whose contact onsets match the true onsets best (F1 score).

    Args:
        pairs: distances in m and true contacts, for many clips.
    """
    touching = np.concatenate([distance[true] for distance, true in pairs])
    touching = touching[np.isfinite(touching)]
    if not len(touching):
        return 0.0
    beyond = touching.max() + np.array([0.0, 0.001, 0.002, 0.005])
    tried = np.unique([*np.quantile(touching, np.linspace(0.02, 1, 60)), *beyond])
    scores = np.array([f1_score(pairs, float(touch)) for touch in tried])
    return float(np.median(tried[scores == scores.max()]))


def f1_score(pairs: Sequence[tuple[Signal, NDArray[np.bool_]]], touch: float) -> float:
    """The F1 score of the contacts found with the threshold `touch`."""
    right = found = true = 0
    for distance, contact in pairs:
        seen, wanted = beginnings(distance < touch), beginnings(contact)
        right += len(matched(seen, wanted))
        found, true = found + len(seen), true + len(wanted)
    return 2 * right / max(found + true, 1)


def _predictions(folder: Path, most: int) -> Iterator[Prediction]:
    card = DatasetCard.read(folder)
    estimator = catalog().create("estimator", card.environment.name, card=card.environment)
    for split in card.splits:
        episodes = EpisodeDataset(folder, cast(Split, split))
        for index in range(min(most, len(episodes))):
            yield Prediction.truth(episodes[index], card.environment, estimator)


def main() -> None:
    """Calibrate the environments of some data folders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", nargs="+", type=Path, help="data folders of true videos")
    parser.add_argument("--out", type=Path, required=True, help="JSON file, changed in place")
    parser.add_argument("--clips", type=int, default=160, help="episodes per split, at most")
    options = parser.parse_args()
    by_world: dict[str, list[Prediction]] = defaultdict(list)
    for folder in options.data:
        for prediction in _predictions(folder, options.clips):
            by_world[prediction.card.name].append(prediction)
    limits = json.loads(options.out.read_text("utf-8")) if options.out.exists() else {}
    limits |= {name: calibrate(predictions) for name, predictions in by_world.items()}
    options.out.write_text(json.dumps(limits, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    main()
