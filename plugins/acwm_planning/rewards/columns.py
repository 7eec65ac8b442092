"""Recorded columns of which a reward can be learnt."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.state_field import StateField
from acwm_core.errors import DataError, suggest

FACTS = {
    "next.reward": "rewards",
    "reward": "rewards",
    "next.success": "successes",
    "success": "successes",
}
"""Names in sources of columns that imports keep as facts of the episodes, under another name."""

_OUTCOME = re.compile(
    r"^next\.|(^|[./_])(rewards?|success(es)?|dones?|terminals?|terminated|truncated)$"
)


@dataclass(frozen=True)
class Column:
    """A column with one number for each row of an episode.

    Attributes:
        name: of the field of the state, or of the fact of the episodes.
        recorded: whether it is a field of the state.
    """

    name: str
    recorded: bool

    @property
    def ahead(self) -> int:
        """1 if a row has the reward of its action, which is that of the frame after it; else 0."""
        return int(not self.recorded or self.name.startswith("next."))

    def rewards(self, episodes: EpisodeDataset, index: int) -> NDArray[np.float64]:
        """The rewards of the frames of an episode, `[T]`.

        The first frame of a column of actions' rewards has none (NaN). The last row's action leads
        to no frame, so its reward, which may be the only success, is taken for the last frame's.

        Raises:
            DataError: a number is not finite, or there are not as many as frames.
        """
        where = f"episode {index} of {episodes.split} of {episodes.path}"
        if self.recorded:
            values = episodes.states(index, [self.name])[:, 0].astype(np.float64)
        else:
            values = _numbers(episodes.about(index)["facts"].get(self.name))
            if len(values) != episodes.lengths[index]:
                raise DataError(
                    f"{where} has {episodes.lengths[index]} frames and {len(values)} numbers in "
                    f"{self.name}: import it without resampling or trimming, or with {self.name} "
                    "among its states"
                )
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise DataError(f"{where} has a {self.name} of {values[row]} in row {row}")
        if self.ahead:
            values = np.concatenate([[math.nan], values[:-2], values[-1:]])[: len(values)]
        return values


def is_outcome(field: StateField) -> bool:
    """Whether a field tells how an episode went, such as its success, and not where things are."""
    return _OUTCOME.search(field.name) is not None


def find_column(episodes: EpisodeDataset, name: str) -> Column:
    """The column of a name.

    Raises:
        DataError: there is none of one number for each frame.
    """
    states = [f.name for f in episodes.card.environment.state if math.prod(f.shape) == 1]
    facts = episodes.about(0)["facts"]
    lists = [key for key, value in facts.items() if len(_numbers(value))]
    if name in states:
        return Column(name, True)
    for alias in (name, FACTS.get(name, "")):
        if alias in lists:
            return Column(alias, False)
    known = [*states, *lists]
    kept = f"it keeps {', '.join(known)}" if known else "import it with one among its states"
    raise DataError(
        f"{episodes.path} keeps no column {name!r} of one number for each frame"
        f"{suggest(name, known)}; {kept}"
    )


def _numbers(fact: object) -> NDArray[np.float64]:
    """A fact of an episode as numbers `[N]`; none if it is no list of numbers."""
    try:
        values = np.asarray(fact if isinstance(fact, list) else [])
    except ValueError:
        return np.zeros(0)
    plain = values.ndim == 1 and values.dtype.kind in "fiub"
    return values.astype(np.float64) if plain else np.zeros(0)
