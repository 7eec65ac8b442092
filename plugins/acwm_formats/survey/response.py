"""How a video goes on after an action: whether what has moved stays there or moves back."""

from __future__ import annotations

import numpy as np

from acwm_formats.survey.following import Seen
from acwm_formats.survey.regression import Numbers, fitted, standard

BEFORE, AFTER = 2, 8  # frames around that of an action, in which the video answers it
FEWEST = 5  # rows of a stretch
RIDGE = 1e-3


def lasting(seen: Seen, shift: int, weights: Numbers) -> tuple[float, float]:
    """The share of the motion by an action that is left `AFTER` frames later, and its error.

    Of each action a motion is read from the change of frames, and that in turn is explained by the
    actions around it. The sum over all of them is what stays; the sum of those that are positive is
    the whole motion. The error is that of a jackknife over groups.

    Args:
        seen: stretches with the actions that `shift` frames later are read best.
        weights: how much each action counts, ``[A]``; they add up to 1.
    """
    squares, products = _moments(seen, shift)
    groups = len(squares)
    every = squares.sum(0), products.sum(0)
    share = _share(*every, weights)
    without = [
        _share(every[0] - s, every[1] - p, weights) for s, p in zip(squares, products, strict=True)
    ]
    error = np.sqrt((groups - 1) * np.var(without))
    return share, float(error)


def _moments(seen: Seen, shift: int) -> tuple[Numbers, Numbers]:
    """Sums of each group over actions by actions around, ``[G, A, L, L]``, and by motions."""
    known = [np.concatenate([np.ones((len(place), 1)), place], 1) for place in seen.place]
    both = [np.concatenate(pair, 1) for pair in zip(known, seen.change, strict=True)]
    targets = standard([a[r - shift] for a, r in zip(seen.actions, seen.rows, strict=True)])
    read, first = fitted(both, targets, seen.groups), known[0].shape[1]
    count, size = int(seen.groups.max()) + 1, targets[0].shape[1]
    lags = range(-BEFORE, AFTER + 1)
    squares = np.zeros((count, size, len(lags), len(lags)))
    products = np.zeros((count, size, len(lags)))
    stretches = zip(seen.groups, seen.actions, seen.rows, seen.change, read, strict=True)
    for group, actions, rows, change, weights in stretches:
        places = rows - shift
        inside = (places >= AFTER) & (places + BEFORE < len(actions))
        if inside.sum() < FEWEST:
            continue
        motion = (change @ weights[first:])[inside]
        around = np.stack([actions[places[inside] - lag] for lag in lags], 2)
        motion, around = motion - motion.mean(0), around - around.mean(0)
        squares[group] += np.einsum("nal,nam->alm", around, around)
        products[group] += np.einsum("nal,na->al", around, motion)
    return squares, products


def _share(squares: Numbers, products: Numbers, weights: Numbers) -> float:
    size = squares.shape[-1]
    ridge = RIDGE * np.trace(squares, axis1=1, axis2=2) / size + 1e-12
    solved = np.linalg.solve(squares + ridge[:, None, None] * np.eye(size), products[..., None])
    answer = weights @ solved[..., 0]
    return float(answer.sum() / max(np.maximum(answer, 0).sum(), 1e-12))
