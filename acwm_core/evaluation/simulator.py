"""The simulator that made a dataset, to ask it for what the dataset does not hold."""

from __future__ import annotations

import numpy as np

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.environment import Environment
from acwm_core.errors import AcwmError, DataError

TRIED_FRAMES = 8
"""Of the first episode, which the simulator must make again."""

SAME = 1 / 255
"""Mean difference up to which a video counts as the same: other machines round otherwise."""


def simulator_of(episodes: EpisodeDataset) -> Environment:
    """The environment that simulated these episodes.

    Raises:
        DataError: why there is none: they were recorded, it is not installed, or it has changed.
    """
    card = episodes.card
    if card.source:
        raise DataError("the data was recorded, so there is no simulator to ask")
    try:
        environment = make_environment(card.environment.name, card.options)
    except AcwmError as error:
        raise DataError(f"its simulator cannot be had ({error})") from error
    first = episodes[0]
    frames = min(TRIED_FRAMES, len(first.video))
    again = simulate(environment, first.spec, first.actions[:frames], frames=frames)
    if np.abs(again.video - first.video[:frames].astype(float)).mean() / 255 > SAME:
        environment.close()
        raise DataError(
            "the simulator installed here makes other videos than the data holds: generate the "
            "data again"
        )
    return environment
