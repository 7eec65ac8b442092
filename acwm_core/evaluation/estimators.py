"""Which estimator reads an environment."""

from __future__ import annotations

from typing import Any

from acwm_core.catalog import catalog
from acwm_core.environment import EnvironmentCard
from acwm_core.errors import PluginError, ShapeError
from acwm_core.estimator import StateEstimator


def estimator_for(card: EnvironmentCard) -> StateEstimator | None:
    """The estimator that is registered under the card's name; None if there is none.

    None as well if it does not read data with this card, such as other people's recordings of the
    same task, which show no masks.

    Raises:
        PluginError: what is registered is no `StateEstimator`.
        MissingExtraError, DataError: it cannot be had, or its weights cannot be read.
    """
    if card.name not in catalog().registry("estimator"):
        return None
    try:
        made: Any = catalog().create("estimator", card.name, card=card)
    except ShapeError:
        return None
    if not isinstance(made, StateEstimator):
        kind = type(made).__name__
        raise PluginError(f"estimator {card.name!r} makes a {kind}, which is no StateEstimator")
    return made
