"""The initial shape of the rope: a smooth random curve at rest."""

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import RecipeError
from acwm_deformable.rope import NODES, Cord, Rope

ROOM = (1.0, 0.88)
"""Half width and half depth in metres of the rectangle in which the rope starts."""

_GAP = 0.22
"""Least distance in metres between the centre lines of two strands, for any thickness."""

_FAR = (100.0, 100.0)  # position of the pole in metres while a rope settles
_STILL = 3e-6  # metres per frame below which a rope is at rest
_MAX_FRAMES = 40  # most frames to settle
_MAX_DRAWS = 1000


def lay_rope(cord: Cord, rng: np.random.Generator) -> Rope:
    """A rope at rest in a random curve that does not cross itself, with the pole far away.

    A drawn curve springs back until its stiffness and the table's friction are in balance.

    Raises:
        RecipeError: the rope is too long and stiff for the table.
    """
    for _ in range(_MAX_DRAWS):
        nodes = _draw(cord, rng)
        if nodes is not None:
            rope = Rope(cord, nodes, _FAR)
            _settle(rope)
            if _fits(rope.nodes, cord):
                return rope
    raise RecipeError(
        f"a rope of length {cord.length:g} m and stiffness {cord.stiffness:g} N·m² springs off the "
        "table: make it shorter or softer, or raise its friction"
    )


def _draw(cord: Cord, rng: np.random.Generator) -> NDArray[np.float64] | None:
    """Draw a curve in the room; None if it does not fit."""
    along = np.linspace(0.0, 1.0, NODES - 1)
    heading = np.full(NODES - 1, rng.uniform(-np.pi, np.pi))
    strength = rng.uniform(0.4, 1.6)
    for waves in (1, 2, 3):
        swing = strength * rng.normal() / waves
        heading += swing * np.sin(np.pi * waves * along + rng.uniform(0, 2 * np.pi))
    steps = cord.spacing * np.column_stack([np.cos(heading), np.sin(heading)])
    nodes = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    low, high = nodes.min(0), nodes.max(0)
    slack = 2 * np.array(ROOM) - (high - low)
    if (slack < 0).any():
        return None
    nodes += rng.uniform(-np.array(ROOM) - low, np.array(ROOM) - high)
    return nodes if _fits(nodes, cord) else None


def _fits(nodes: NDArray[np.floating], cord: Cord) -> bool:
    """Whether a curve lies in the room and its strands keep their distance."""
    if (np.abs(nodes) > ROOM).any():
        return False
    away = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    apart = int(np.ceil(0.5 * np.pi * _GAP / cord.spacing)) + 1
    return bool((away[np.triu_indices(NODES, apart)] > _GAP).all())


def _settle(rope: Rope) -> None:
    for _ in range(_MAX_FRAMES):
        before = rope.nodes.copy()
        rope.advance((0.0, 0.0))
        if np.abs(rope.nodes - before).max() < _STILL:
            break
    rope.velocities[:] = 0
