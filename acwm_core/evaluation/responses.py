"""From predicted and true responses of many clips to a summary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.environment import ActionSpec
from acwm_core.evaluation.branches import Branch
from acwm_core.evaluation.estimates import Estimate, finite
from acwm_core.evaluation.findings import Counterfactual, ResponseCurve
from acwm_core.evaluation.plans import ClipPlan
from acwm_core.evaluation.statistics import Column
from acwm_core.metric import Metric, Rollout

ALL = "all"
"""Stands for all kinds of branches together."""


@dataclass(frozen=True)
class Answer:
    """One row's answer to the branches of a clip.

    Attributes:
        plan: which clip it is.
        rollout: the clip, with its branches.
        branches: what they ask for, in the same order.
    """

    plan: ClipPlan
    rollout: Rollout
    branches: Sequence[Branch]


@dataclass(frozen=True)
class Energies:
    """Sums over pixels and channels of a branch's responses, frame by frame, each `[T]`.

    Attributes:
        true: Σ Δ*².
        along: Σ Δ·Δ*.
        predicted: Σ Δ².
        values: pixels times channels.
    """

    true: NDArray[np.float64]
    along: NDArray[np.float64]
    predicted: NDArray[np.float64]
    values: int

    @classmethod
    def of(cls, factual: Rollout, branch: Rollout) -> Energies:
        """Those of one branch."""
        true = (branch.target.double() - factual.target).flatten(1)
        predicted = (branch.prediction.double() - factual.prediction).flatten(1)
        products = (true * true, predicted * true, predicted * predicted)
        sums = [torch.as_tensor(each).sum(1).numpy() for each in products]
        return cls(sums[0], sums[1], sums[2], true.shape[1])


@dataclass(frozen=True)
class Asked:
    """What a branch asked for, and the energies of one row's answer.

    Attributes:
        size: of the shift, 0 if it is none.
        shift: mean change of each action dimension, `[A]`.
        energies: of the answer.
    """

    size: float
    shift: NDArray[np.float64]
    energies: Energies


class Responses:
    """Collects answers, clip by clip.

    Args:
        metrics: of branches, by registered name.
        action: names and units of the action's dimensions.
        seed: of the bootstrap.
    """

    def __init__(self, metrics: Mapping[str, Metric], action: ActionSpec, seed: int) -> None:
        self.metrics, self.action, self.seed = metrics, action, seed
        self._clips: dict[tuple[str, int], int] = {}  # frames, by split and episode
        self._scores: dict[tuple[str, str, str], list[tuple[float, float, int]]] = {}
        self._asked: dict[tuple[str, str], list[Asked]] = {}

    def add(self, row: str, answer: Answer) -> None:
        """Score one row's answer to a clip's branches."""
        rollout, plan = answer.rollout, answer.plan
        self._clips[plan.split, plan.episode] = len(rollout.target)
        kinds = [branch.kind for branch in answer.branches]
        for kind in (ALL, *dict.fromkeys(kinds)):
            among = [
                each
                for own, each in zip(kinds, rollout.branches, strict=True)
                if kind in (ALL, own)
            ]
            self._score(row, kind, replace(rollout, branches=tuple(among)), plan.episode)
        for branch, made in zip(answer.branches, rollout.branches, strict=True):
            shift = np.abs(branch.actions - rollout.actions)[:-1].mean(0, dtype=np.float64)
            asked = Asked(branch.size, shift, Energies.of(rollout, made))
            self._asked.setdefault((row, branch.kind), []).append(asked)

    def summary(self) -> Counterfactual:
        """What was found."""
        rows = list(dict.fromkeys(row for row, _ in self._asked))
        kinds = list(dict.fromkeys(kind for _, kind in self._asked))
        groups = {ALL: kinds, **{kind: [kind] for kind in kinds}}
        parts = {
            group: {row: decompose(self._of(row, members)) for row in rows}
            for group, members in groups.items()
        }
        return Counterfactual(
            clips=len(self._clips),
            frames=max(self._clips.values(), default=0),
            branches=sum(len(self._asked[rows[0], kind]) for kind in kinds) if rows else 0,
            rows={row: self._estimates(row, ALL) for row in rows},
            kinds={kind: {row: self._estimates(row, kind) for row in rows} for kind in kinds},
            gain={group: {row: each[0] for row, each in p.items()} for group, p in parts.items()},
            stray={group: {row: each[1] for row, each in p.items()} for group, p in parts.items()},
            curves=[c for kind in kinds for c in self._curves(kind, rows)],
        )

    def _score(self, row: str, kind: str, rollout: Rollout, episode: int) -> None:
        for name, metric in self.metrics.items():
            with torch.autocast("cpu", enabled=False):
                scored = metric.value(rollout), metric.weight(rollout), episode
            self._scores.setdefault((row, kind, name), []).append(scored)

    def _of(self, row: str, kinds: Iterable[str]) -> list[Energies]:
        return [asked.energies for kind in kinds for asked in self._asked[row, kind]]

    def _estimates(self, row: str, kind: str) -> dict[str, Estimate]:
        found: dict[str, Estimate] = {}
        for name, metric in self.metrics.items():
            values, weights, episodes = np.array(self._scores[row, kind, name], np.float64).T
            clips = np.stack([episodes, np.zeros_like(episodes)], 1).astype(np.int64)
            found[name] = Column(values, weights, clips).estimate(metric, self.seed)
        return found

    def _curves(self, kind: str, rows: Sequence[str]) -> list[ResponseCurve]:
        """The curves of an action dimension, one for each size; none for other kinds."""
        curves: list[ResponseCurve] = []
        for size in sorted({asked.size for asked in self._asked[rows[0], kind] if asked.size}):
            same = {row: [a for a in self._asked[row, kind] if a.size == size] for row in rows}
            energies = {row: [asked.energies for asked in each] for row, each in same.items()}
            dimension = self.action.names.index(kind)
            shifts = [asked.shift[dimension] for asked in same[rows[0]]]
            curves.append(
                ResponseCurve(
                    dimension=kind,
                    unit=self.action.units[dimension],
                    size=size,
                    shift=float(np.mean(shifts)),
                    truth=true_response(energies[rows[0]]).tolist(),
                    rows={row: predicted_response(each) for row, each in energies.items()},
                )
            )
        return curves


def decompose(energies: Sequence[Energies]) -> tuple[float | None, float | None]:
    """Gain and stray energy of responses, see `Counterfactual`; None without a true response."""
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
