"""Ridge regression across episodes: how well some numbers predict others in held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

Rows = Sequence[Numbers]
"""Rows of numbers: an array ``[n, k]`` for each stretch; n may differ, k not."""

PENALTIES = 10.0 ** np.arange(-5.0, 2.0)  # in units of the number of rows
FOLDS = 5
LIMIT = 4.0  # standard deviations that a number is cut to, so that no single one decides


def standard(rows: Rows) -> list[Numbers]:
    """Columns of zero mean and unit variance; numbers far out are cut."""
    every = np.concatenate(rows)
    mean, size = every.mean(0), every.std(0) + 1e-9
    return [np.clip((part - mean) / size, -LIMIT, LIMIT) for part in rows]


def fitted(inputs: Rows, targets: Rows, groups: NDArray[np.int64]) -> list[Numbers]:
    """Weights ``[inputs, targets]`` for each stretch, learned without the stretches of its fold.

    A fold is made of whole groups. The penalty of each target is that which did best in the other
    folds.
    """
    folds = groups % min(FOLDS, int(groups.max()) + 1)
    pairs = list(zip(inputs, targets, strict=True))
    squares = _by_fold([x.T @ x for x in inputs], folds)
    products = _by_fold([x.T @ y for x, y in pairs], folds)
    sums = _by_fold([(y**2).sum(0) for y in targets], folds)
    rows = _by_fold([np.array(float(len(x))) for x in inputs], folds)
    every = [_candidates(squares, products, rows, fold) for fold in range(len(rows))]
    parts = zip(every, squares, products, sums, strict=True)
    errors = np.stack([_errors(*part) for part in parts])  # [fold, penalty, target]
    chosen: list[Numbers] = []
    for fold, candidates in enumerate(every):
        best = (errors.sum(0) - errors[fold]).argmin(0)
        chosen.append(candidates[best, :, np.arange(len(best))].T)
    return [chosen[fold] for fold in folds]


def residuals(inputs: Rows, targets: Rows, groups: NDArray[np.int64]) -> list[Numbers]:
    """What `inputs` do not predict of `targets`."""
    weights = fitted(inputs, targets, groups)
    return [y - x @ w for x, y, w in zip(inputs, targets, weights, strict=True)]


def gains(
    known: Rows,
    inputs: Rows,
    targets: Rows,
    groups: NDArray[np.int64],
    others: Sequence[Sequence[int]],
) -> Numbers:
    """The share of the targets' variance that a stretch's own inputs explain, ``[target, group]``.

    `known` is given besides. The share is half the difference to the error with the inputs of
    `others`, indices of other stretches for each, so it is zero on average if inputs and targets
    only have their time in common.
    """
    both = [np.concatenate(pair, 1) for pair in zip(known, inputs, strict=True)]
    weights = fitted(both, targets, groups)
    size, split = np.concatenate(targets).var(0) + 1e-12, known[0].shape[1]
    parts: list[Numbers] = []
    for index, (y, w) in enumerate(zip(targets, weights, strict=True)):
        left, gain = y - known[index] @ w[:split], np.zeros(y.shape[1])
        own = (left - inputs[index] @ w[split:]) ** 2
        for other in others[index]:
            n = min(len(left), len(inputs[other]))
            wrong = (left[:n] - inputs[other][:n] @ w[split:]) ** 2
            gain += (wrong - own[:n]).mean(0) / (2 * size * len(others[index]))
        parts.append(gain)
    gathered = np.stack(parts, 1)
    return np.stack([gathered[:, groups == g].mean(1) for g in range(int(groups.max()) + 1)], 1)


def _by_fold(parts: Sequence[Numbers], folds: NDArray[np.int64]) -> Numbers:
    """Sums of parts over each fold."""
    total = np.zeros((int(folds.max()) + 1, *np.shape(parts[0])))
    np.add.at(total, folds, np.stack(parts))
    return total


def _candidates(squares: Numbers, products: Numbers, rows: Numbers, fold: int) -> Numbers:
    """Weights learned from all folds but one, ``[penalty, inputs, targets]``."""
    values, axes = np.linalg.eigh(squares.sum(0) - squares[fold])
    turned = axes.T @ (products.sum(0) - products[fold])
    penalties = PENALTIES * (rows.sum() - rows[fold])
    return np.stack([axes @ (turned / (np.maximum(values, 0) + p)[:, None]) for p in penalties])


def _errors(weights: Numbers, squares: Numbers, products: Numbers, sums: Numbers) -> Numbers:
    """Sums of squared errors in a fold, ``[penalty, target]``."""
    cross = (weights * products).sum(1)
    return sums - 2 * cross + (weights * (squares @ weights)).sum(1)
