"""Branches: the other action sequences that a clip's counterfactual test asks about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import ActionSpec

SIZES = (0.1, 0.5)
"""Shifts of one dimension, as shares of half its range."""

Rows = NDArray[np.float32]
"""Raw actions `[T, A]`; the last row leads to no frame and is zero."""


@dataclass(frozen=True)
class Branch:
    """Another action sequence from the same first frame.

    Attributes:
        kind: ``"another"``, ``"still"``, ``"reversed"``, ``"mirrored"``, or the name of the
            dimension that is shifted.
        actions: `[T, A]`.
        size: of a shift, as a share of half the dimension's range; 0 for other kinds.
    """

    kind: str
    actions: Rows
    size: float = 0.0


def most_branches(spec: ActionSpec) -> int:
    """How many branches `plan_branches` plans at most."""
    return 4 + len(SIZES) * spec.size


def plan_branches(actions: Rows, another: Rows, still: Rows, spec: ActionSpec) -> list[Branch]:
    """All branches of a clip, without those that ask for what the clip itself asks for.

    * ``another``: another episode's actions.
    * ``still``: nothing moves.
    * ``reversed``: the clip's actions in reversed order.
    * ``mirrored``: the opposite of each action, 2·still − action, as far as the bounds allow.
    * for each dimension and each of `SIZES`: the action, shifted throughout; to the side on which
      the bounds leave more of the shift.

    Args:
        actions: of the clip, `[T, A]`.
        another: of the other episode, `[T, A]`.
        still: the action `[A]` that asks for no motion at the start.
        spec: names and bounds.
    """
    low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
    taken = actions[:-1]
    whole = {
        "another": another[:-1],
        "still": np.tile(still, (len(taken), 1)),
        "reversed": taken[::-1],
        "mirrored": np.clip(2 * still - taken, low, high),
    }
    branches = [Branch(kind, _closed(rows)) for kind, rows in whole.items()]
    for dimension, name in enumerate(spec.names):
        for size in SIZES:
            rows = _shifted(taken, dimension, size, spec)
            branches.append(Branch(name, _closed(rows), size))
    return [branch for branch in branches if not np.array_equal(branch.actions, actions)]


def _shifted(taken: Rows, dimension: int, size: float, spec: ActionSpec) -> Rows:
    low, high = spec.low[dimension], spec.high[dimension]
    values, step = taken[:, dimension], size * (high - low) / 2
    up, down = np.clip(values + step, low, high), np.clip(values - step, low, high)
    rows = taken.copy()
    rows[:, dimension] = up if (up - values).sum() >= (values - down).sum() else down
    return rows


def _closed(rows: Rows) -> Rows:
    """The rows with a last one that is zero."""
    return np.concatenate([rows, np.zeros((1, rows.shape[1]))]).astype(np.float32)
