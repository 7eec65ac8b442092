"""The card of an environment of Gymnasium, as far as it can be found out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.errors import RecipeError

GymEnv = gymnasium.Env[Any, Any]

SIZE, HORIZON = 64, 60
"""Sides of a frame, and frames of an episode; the author of the package changes them."""


def card_of(env_id: str, name: str) -> EnvironmentCard:
    """Describe an environment: its actions, rate and observations.

    A dict of vectors gives a state field each, one vector the field ``observation``. Actions of a
    `Discrete` space become one-hot.

    Args:
        env_id: as in `gymnasium.make`.
        name: of the environment to be, one word.

    Raises:
        RecipeError: it cannot be made, its actions are neither a bounded box nor discrete, or it
            states no rate.
    """
    try:
        env: GymEnv = gymnasium.make(env_id, render_mode="rgb_array")
    except Exception as error:  # whatever a package raises that lacks something
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise RecipeError(f"--from-gym {env_id} cannot be made ({why})") from error
    try:
        low, high = _bounds(env)
        seen, _ = env.reset(seed=0)
        rate = env.metadata.get("render_fps") or 1 / getattr(env.unwrapped, "dt", math.nan)
        if not 0 < rate < math.inf:
            raise RecipeError(f"{env_id} states no frame rate (metadata render_fps)")
        names = tuple(f"action_{place}" for place in range(len(low)))
        fields = _vectors(seen)
        return EnvironmentCard(
            name=name,
            summary=f"{env_id} of Gymnasium.",
            action=ActionSpec(names, ("",) * len(low), low, high, "torque"),
            frame_size=(SIZE, SIZE),
            fps=float(rate),
            horizon=HORIZON,
            factors=(),
            ood_shifts=(),
            state=tuple(StateField(n, v.shape, "", "observed") for n, v in fields.items()),
            instances=("unlabelled",),
            engine="Gymnasium",
        )
    finally:
        env.close()


def _bounds(env: GymEnv) -> tuple[tuple[float, ...], tuple[float, ...]]:
    space = env.action_space
    if isinstance(space, Discrete):
        return (0.0,) * int(space.n), (1.0,) * int(space.n)
    if not isinstance(space, Box) or not np.isfinite([space.low, space.high]).all():
        raise RecipeError(f"actions in {space}: only a bounded Box or Discrete can be used")
    low, high = (cast(Sequence[float], b.ravel().tolist()) for b in (space.low, space.high))
    return tuple(low), tuple(high)


def _vectors(seen: Any) -> dict[str, NDArray[Any]]:
    """The vectors of an observation, by name; others are left out."""
    parts: Mapping[str, Any] = seen if isinstance(seen, Mapping) else {"observation": seen}
    arrays = {name: np.atleast_1d(np.asarray(value)) for name, value in parts.items()}
    return {
        name: v for name, v in arrays.items() if v.ndim == 1 and v.size and v.dtype.kind in "fiu"
    }
