"""From predicted and true responses to other actions, of many clips, to a summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.environment import ActionSpec
from acwm_core.evaluation.clip_results import summary_of
from acwm_core.evaluation.clips import ClipPlan
from acwm_core.evaluation.results import Counterfactual, ResponseCurve
from acwm_core.metric import Metric, Rollout
from acwm_core.statistics import ClipScores, Estimate, finite

ALL = "all"
"""Stands for all kinds of branches together."""


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
    actions: NDArray[np.float32]
    size: float = 0.0


@dataclass(frozen=True)
class Energies:
    """One row's response to a branch, as sums over pixels and channels, frame by frame, each `[T]`.

    Attributes:
        kind: of the branch.
        size: of its shift, 0 if it is none.
        shift: mean change of each action dimension, `[A]`.
        true: Σ Δ*².
        along: Σ Δ·Δ*.
        predicted: Σ Δ².
        values: pixels times channels.
    """

    kind: str
    size: float
    shift: NDArray[np.float64]
    true: NDArray[np.float64]
    along: NDArray[np.float64]
    predicted: NDArray[np.float64]
    values: int

    @classmethod
    def of(cls, factual: Rollout, branch: Branch, made: Rollout) -> Energies:
        """Those of one branch."""
        shift = np.abs(branch.actions - factual.actions)[:-1].mean(0, dtype=np.float64)
        true = (made.target.double() - factual.target).flatten(1)
        predicted = (made.prediction.double() - factual.prediction).flatten(1)
        return cls(
            branch.kind,
            branch.size,
            shift,
            true=(true * true).sum(1).numpy(),
            along=(predicted * true).sum(1).numpy(),
            predicted=(predicted * predicted).sum(1).numpy(),
            values=true.shape[1],
        )


class ActionResponses:
    """Collects the responses of rows, clip by clip.

    Args:
        metrics: of branches, by registered name.
        action: names and units of the action's dimensions.
        seed: of the bootstrap.
    """

    def __init__(self, metrics: Mapping[str, Metric], action: ActionSpec, seed: int) -> None:
        self.metrics, self.action, self.seed = metrics, action, seed
        self._frames: dict[tuple[str, int], int] = {}  # by split and episode
        self._scores: dict[tuple[str, str, str], list[tuple[float, float, int]]] = {}
        self._energies: dict[str, list[Energies]] = {}  # by row

    def add(self, row: str, plan: ClipPlan, rollout: Rollout, branches: Sequence[Branch]) -> None:
        """Score one row's responses to the branches of a clip.

        Args:
            row: its name.
            plan: which clip it is.
            rollout: the clip, with its branches.
            branches: what they ask for, in the same order.
        """
        self._frames[plan.split, plan.episode] = len(rollout.target)
        pairs = list(zip(branches, rollout.branches, strict=True))
        for kind in (ALL, *dict.fromkeys(branch.kind for branch in branches)):
            among = tuple(made for branch, made in pairs if kind in (ALL, branch.kind))
            self._score(row, kind, replace(rollout, branches=among), plan.episode)
        self._energies.setdefault(row, []).extend(
            Energies.of(rollout, branch, made) for branch, made in pairs
        )

    def summary(self) -> Counterfactual:
        """What was found."""
        rows = list(self._energies)
        first = self._energies[rows[0]] if rows else []
        kinds = list(dict.fromkeys(each.kind for each in first))
        gain: dict[str, dict[str, float | None]] = {}
        residual: dict[str, dict[str, float | None]] = {}
        for kind in (ALL, *kinds):
            found = {row: decompose(self._of(row, kind)) for row in rows}
            gain[kind] = {row: each[0] for row, each in found.items()}
            residual[kind] = {row: each[1] for row, each in found.items()}
        return Counterfactual(
            clips=len(self._frames),
            frames=max(self._frames.values(), default=0),
            branches=len(first),
            rows={row: self._estimates(row, ALL) for row in rows},
            kinds={kind: {row: self._estimates(row, kind) for row in rows} for kind in kinds},
            gain=gain,
            residual=residual,
            curves=[
                self._curve(kind, size)
                for kind in kinds
                for size in sorted({each.size for each in first if each.kind == kind and each.size})
            ],
        )

    def _score(self, row: str, kind: str, rollout: Rollout, episode: int) -> None:
        for name, metric in self.metrics.items():
            with torch.autocast("cpu", enabled=False):
                scored = metric.value(rollout), metric.weight(rollout), episode
            self._scores.setdefault((row, kind, name), []).append(scored)

    def _of(self, row: str, kind: str, size: float | None = None) -> list[Energies]:
        return [
            each
            for each in self._energies[row]
            if kind in (ALL, each.kind) and size in (None, each.size)
        ]

    def _estimates(self, row: str, kind: str) -> dict[str, Estimate]:
        found: dict[str, Estimate] = {}
        for name, metric in self.metrics.items():
            values, weights, episodes = np.array(self._scores[row, kind, name], np.float64).T
            clips = np.stack([episodes, np.zeros_like(episodes)], 1).astype(np.int64)
            scores = ClipScores(values, weights, clips, summary_of(metric))
            found[name] = scores.estimate(self.seed)
        return found

    def _curve(self, kind: str, size: float) -> ResponseCurve:
        """The curve of an action dimension for shifts of one size."""
        same = {row: self._of(row, kind, size) for row in self._energies}
        first = next(iter(same.values()))
        dimension = self.action.names.index(kind)
        return ResponseCurve(
            dimension=kind,
            unit=self.action.units[dimension],
            size=size,
            shift=float(np.mean([each.shift[dimension] for each in first])),
            truth=true_response(first).tolist(),
            rows={row: predicted_response(each) for row, each in same.items()},
        )


def decompose(energies: Sequence[Energies]) -> tuple[float | None, float | None]:
    """Gain and residual energy of responses, see `Counterfactual`; None without a true response."""
    true, along, predicted = (
        sum(float(getattr(each, name).sum()) for each in energies)
        for name in ("true", "along", "predicted")
    )
    if not true > 0:
        return None, None
    gain = along / true
    return finite(gain), finite(predicted / true - gain**2)


def true_response(energies: Sequence[Energies]) -> NDArray[np.float64]:
    """Root mean square of the true response over branches, pixels and channels, `[T]`."""
    total = _summed(energies, "true")
    return np.sqrt(total / sum(each.values for each in energies))


def predicted_response(energies: Sequence[Energies]) -> list[float | None]:
    """The part of the predicted response that is the true one, frame by frame."""
    total, along = _summed(energies, "true"), _summed(energies, "along")
    gain = np.full(len(total), np.nan)
    np.divide(along, total, out=gain, where=total > 0)
    return [finite(value) for value in gain * true_response(energies)]


def _summed(energies: Sequence[Energies], name: str) -> NDArray[np.float64]:
    sums = np.zeros(max(len(each.true) for each in energies))
    for each in energies:
        sums[: len(each.true)] += getattr(each, name)
    return sums
