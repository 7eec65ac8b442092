"""What the actions of a dataset are like, one by one: range, histogram, outliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_core.env.episode import Split
from acwm_core.errors import DataError
from acwm_formats.survey.sample import Unread, all_places, spread

EPISODES = 4000  # most episodes whose actions are read
ROWS = 400_000  # most rows of actions that are kept
BINS = 40
NARROW = 0.2  # share of the bounds within which nearly all values lie, if an outlier set them
MOST_CHOICES = 18  # that a person names by numbers; a game pad has as many
NEARLY = 0.01, 0.99  # quantiles
FEW = 8  # values; an action with no more is a choice, and has no outliers


@dataclass(frozen=True)
class ActionSummary:
    """One action.

    Attributes:
        name: its name.
        unit: its unit.
        bounds: those of the card, by which models normalise it.
        least, most: the range of its values.
        quantiles: its 1 % and 99 % quantile.
        mean, std: of its values.
        constant: whether it never changes.
        choices: how many whole numbers from 0 or 1 on it takes, if only such: they may be choices;
            0 otherwise.
        narrow: share of the bounds between the quantiles, if outliers make it small; else None.
        outside: share of values out of the bounds.
        edges: edges of the bins of the histogram.
        counts: values in each bin.
    """

    name: str
    unit: str
    bounds: tuple[float, float]
    least: float
    most: float
    quantiles: tuple[float, float]
    mean: float
    std: float
    constant: bool
    choices: int
    narrow: float | None
    outside: float
    edges: tuple[float, ...]
    counts: tuple[int, ...]


def action_facts(
    data: Mapping[Split, EpisodeDataset], spec: ActionSpec, unread: Unread
) -> list[ActionSummary]:
    """Describe each action; of more than `EPISODES` episodes, as many spread evenly.

    Raises:
        DataError: none can be read.
    """
    places = all_places({split: dataset.lengths for split, dataset in data.items()})
    chosen = [places[place] for place in spread(len(places), EPISODES)]
    room = max(1, ROWS // len(chosen))
    rows = [
        _some(actions[:-1], room)
        for split, index in chosen
        for actions in unread.read(split, index, lambda s=split, i=index: data[s].actions(i))
    ]
    if not rows:
        why = next(iter(unread.places.values()))
        raise DataError(f"none of the {len(chosen)} episodes looked at can be read; {why}")
    every = np.concatenate(rows).astype(np.float64)
    return [_facts(spec, place, every[:, place]) for place in range(every.shape[1])]


def _some(rows: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    return rows if len(rows) <= most else rows[spread(len(rows), most)]


def _facts(spec: ActionSpec, place: int, values: NDArray[np.float64]) -> ActionSummary:
    low, high = float(spec.low[place]), float(spec.high[place])
    least, most = float(values.min()), float(values.max())
    near, far = map(float, np.quantile(values, NEARLY))
    share = (far - near) / max(high - low, 1e-12)
    choice = len(np.unique(values[:100_000])) <= FEW
    counts, edges = np.histogram(values, BINS)
    slack = 1e-6 * (high - low)
    return ActionSummary(
        name=spec.names[place],
        unit=spec.units[place],
        bounds=(low, high),
        least=least,
        most=most,
        quantiles=(near, far),
        mean=float(values.mean()),
        std=float(values.std()),
        constant=most - least <= 1e-6 * max(abs(least), abs(most), 1e-12),
        choices=_choices(values),
        narrow=share if share < NARROW and not choice else None,
        outside=float(((values < low - slack) | (values > high + slack)).mean()),
        edges=tuple(edges.tolist()),
        counts=tuple(counts.tolist()),
    )


def _choices(values: NDArray[np.float64]) -> int:
    """How many whole numbers in a row, from 0 or 1 on; 0 for amounts, and for on and off."""
    known = np.unique(values)
    whole = known[0] in (0, 1) and np.array_equal(known, known[0] + np.arange(len(known)))
    return len(known) if whole and 3 <= len(known) <= MOST_CHOICES else 0
