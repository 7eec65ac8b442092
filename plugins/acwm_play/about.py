"""The description of a world for the page, whether it comes from a server or a file."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_play.layout import Pointing


def about_world(
    name: str,
    card: EnvironmentCard,
    stride: int,
    controls: list[dict[str, Any]],
    pointing: Pointing | None,
) -> dict[str, Any]:
    """Describe what is the same in all scenes of a world.

    Args:
        name: name in the menu.
        card: card of the environment, with the frame size.
        stride: video frames per latent frame.
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
        "views": card.view_names,
        "controls": controls,
        "points": len(controls) // 2 if pointing else 0,
        "reach": [places(pointing, np.array(bound)) for bound in bounds],
    }


def places(pointing: Pointing | None, action: NDArray[Any]) -> list[list[float]] | None:
    """The places in the picture that an action points to; None without `pointing`."""
    return pointing.places(action).tolist() if pointing else None
