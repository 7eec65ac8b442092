"""What the page is told of a world, whether a server tells it or a file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_play.layout import Pointing


def about_world(
    name: str,
    card: EnvironmentCard,
    stride: int,
    controls: list[dict[str, Any]],
    pointing: Pointing | None,
) -> dict[str, Any]:
    """What stays the same in all scenes.

    Args:
        name: in the menu.
        card: of the environment, with the size of its frames.
        stride: frames of a latent frame.
        controls: see `acwm_play.layout.controls`.
        pointing: the map from places in the picture to actions, if there is one.
    """
    bounds = (card.action.low, card.action.high)
    return {
        "name": name,
        "environment": card.name,
        "summary": card.summary,
        "engine": card.engine,
        "fps": card.fps,
        "stride": stride,
        "size": card.frame_size,
        "controls": controls,
        "points": len(controls) // 2 if pointing else 0,
        "reach": [places(pointing, np.array(bound)) for bound in bounds],
    }


def places(pointing: Pointing | None, action: NDArray[Any]) -> list[list[float]] | None:
    """Where in the picture an action points."""
    return pointing.places(action).tolist() if pointing else None
