"""Counterfactual test: other actions from the same first frame, simulated and predicted."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec, Environment
from acwm_core.env.episode import Episode
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import noting
from acwm_core.evaluation.clips import Clip, Predictor, cut_episode, donor_actions, read_clips
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Counterfactual, ResponseCurve
from acwm_core.evaluation.statistics import ClipScores, Estimate, finite
from acwm_core.evaluation.summarise import summary_of
from acwm_core.evaluation.videos import ClipVideo, video_of
from acwm_interventions.simulations import Again, simulate_again

SIZES = (0.1, 0.5)
"""Shifts of one action dimension, as fractions of half its range."""

ROWS: tuple[Predictor, ...] = ("model", "codec")
"""The rows that are compared: the model, and the codec's reconstruction of the true responses,
which is the model's ceiling. The simulator would score 1, repeating the first frame 0."""

ALL = "all"
"""Key for all kinds of branches together."""

ActionRows = NDArray[np.float32]
"""Raw actions `[T, A]`; the last row leads to no frame and is zero."""


@dataclass(frozen=True)
class Branch:
    """Another action sequence from the same first frame."""

    # ``"another"``, ``"still"``, ``"reversed"``, ``"mirrored"``, or the name of the shifted
    # action dimension
    kind: str
    actions: ActionRows  # `[T, A]`
    size: float = 0.0  # size of a shift, as a fraction of half the dimension's range; else 0


Simulated = tuple[list[Branch], Prediction]
"""Other actions for a clip, and the clip's true video with theirs as `Prediction.branches`."""


def max_branches(spec: ActionSpec) -> int:
    """The largest number of branches that `plan_branches` returns."""
    return 4 + len(SIZES) * spec.size


def plan_branches(
    actions: ActionRows, another: ActionRows, still: NDArray[np.float32], spec: ActionSpec
) -> list[Branch]:
    """All branches of a clip, without those whose actions equal the clip's own.

    * ``another``: another episode's actions.
    * ``still``: nothing moves.
    * ``reversed``: the clip's actions in reversed order.
    * ``mirrored``: the opposite of each action, 2·still − action, clipped to the bounds.
    * for each dimension and each of `SIZES`: the actions with this dimension shifted in all frames,
      in the direction in which the bounds cut off less of the shift.
    """
    taken = actions[:-1]
    low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
    asked: list[tuple[str, ActionRows, float]] = [
        ("another", another[:-1], 0.0),
        ("still", np.tile(still, (len(taken), 1)), 0.0),
        ("reversed", taken[::-1], 0.0),
        ("mirrored", np.clip(2 * still - taken, low, high), 0.0),
    ]
    for (dimension, name), size in itertools.product(enumerate(spec.names), SIZES):
        values, bounds = taken[:, dimension], (spec.low[dimension], spec.high[dimension])
        step = size * (bounds[1] - bounds[0]) / 2
        up, down = np.clip(values + step, *bounds), np.clip(values - step, *bounds)
        rows = taken.copy()
        rows[:, dimension] = up if (up - values).sum() >= (values - down).sum() else down
        asked.append((name, rows, size))
    last = np.zeros((1, spec.size))
    branches = [
        Branch(kind, np.concatenate([rows, last]).astype(np.float32), size)
        for kind, rows, size in asked
    ]
    return [branch for branch in branches if not np.array_equal(branch.actions, actions)]


def branches_of(
    environment: Environment, clip: Clip, whole: Episode, episodes: EpisodeDataset, frames: int
) -> tuple[Episode, list[Branch]]:
    """A clip's part `whole` of its episode, cut to at most `frames` frames, and its branches."""
    length = min(frames, len(whole.video))
    episode = cut_episode(whole, 0, length)
    environment.reset(options={"spec": episode.spec})
    free = slice(clip.given - 1, length)
    planned = plan_branches(
        episode.actions[free],
        donor_actions(clip, whole.actions, episodes)[free],
        environment.still_action(),
        environment.card.action,
    )
    common = episode.actions[: free.start]
    return episode, [
        replace(branch, actions=np.concatenate([common, branch.actions])) for branch in planned
    ]


def simulate_branches(
    environment: Environment,
    clips: Sequence[Clip],
    episodes: EpisodeDataset,
    frames: int,
    estimator: StateEstimator | None = None,
) -> Iterator[Simulated]:
    """Simulate each clip again, cut to at most `frames` frames, and its branches."""
    for clip, whole in read_clips(clips, episodes):
        episode, branches = branches_of(environment, clip, whole, episodes, frames)
        taken = [episode.actions, *(branch.actions for branch in branches)]
        asked = [Again(episode.spec, actions, len(episode.video)) for actions in taken]
        truths = [
            Prediction.truth(made, environment.card, estimator, clip)
            for made in simulate_again(environment, asked)
        ]
        yield branches, replace(truths[0], branches=tuple(truths[1:]))


def counterfactual(
    evaluator: Evaluator, metrics: Mapping[str, Metric], simulated: Iterable[Simulated]
) -> tuple[Counterfactual, list[ClipVideo]]:
    """Predict the clips of a split and their branches with the same noise; compare the responses.

    Returns the results, and videos of the first clip and its branches (only the largest shifts).
    """
    responses = ActionResponses(metrics, evaluator.card.action, evaluator.config.seed)
    videos: list[ClipVideo] = []
    for branches, truth in simulated:
        for row in ROWS:
            if row not in evaluator.rows:
                continue
            with noting(truth.clip.where, *evaluator.world_model.children()):
                prediction = _predicted(evaluator, truth, row)
                responses.add(row, branches, prediction)
            if row == "model" and not videos:
                videos = _videos(prediction, branches)
    return responses.summary(), videos


def _predicted(evaluator: Evaluator, truth: Prediction, row: Predictor) -> Prediction:
    """A clip and its branches as `row` predicts them, from the last context frame on."""
    truths, made = [truth, *truth.branches], list[Prediction]()
    size = evaluator.config.batch_size
    for first in range(0, len(truths), size):
        batch = truths[first : first + size]
        made += evaluator.predict(batch, [row])
        evaluator.advance(len(batch))
    return replace(made[0], branches=tuple(made[1:])).without(truth.clip.given - 1)


def _videos(prediction: Prediction, branches: Sequence[Branch]) -> list[ClipVideo]:
    largest = max((branch.size for branch in branches), default=0.0)
    named = [("factual", prediction)] + [
        (branch.kind, each)
        for branch, each in zip(branches, prediction.branches, strict=True)
        if branch.size in (0.0, largest)
    ]
    clip = prediction.clip
    return [
        video_of(
            each,
            f"{clip.split}-{clip.episode:06d}-branch-{number:02d}.mp4",
            kind=f"branch:{kind}",
            pick="counterfactual",
            actions=each.actions,
        )
        for number, (kind, each) in enumerate(named)
    ]


@dataclass(frozen=True)
class Energies:
    """One row's response to a branch."""

    branch: Branch
    shift: NDArray[np.float64]  # mean absolute change of each action dimension, `[A]`
    # sums over pixels and channels per frame, `[3, T]`: squared true response, true times
    # predicted response, squared predicted response
    sums: NDArray[np.float64]
    values: int  # pixels times channels

    @classmethod
    def of(cls, factual: Prediction, branch: Branch, made: Prediction) -> Energies:
        """Compute them for one branch."""
        shift = np.abs(made.actions - factual.actions)[:-1].mean(0, dtype=np.float64)
        true = (made.target.double() - factual.target).flatten(1)
        predicted = (made.video.double() - factual.video).flatten(1)
        products = true * true, predicted * true, predicted * predicted
        return cls(branch, shift, torch.stack([p.sum(1) for p in products]).numpy(), true.shape[1])


class ActionResponses:
    """Collects the responses of all rows, clip by clip; `metrics` must compare branches."""

    def __init__(self, metrics: Mapping[str, Metric], action: ActionSpec, seed: int) -> None:
        self.metrics, self.action, self.seed = metrics, action, seed
        self._frames: dict[tuple[str, int], int] = {}  # by split and episode
        self._scores: dict[tuple[str, str, str], list[tuple[float, float, int, int]]] = {}
        self._energies: dict[str, list[Energies]] = {}  # by row

    def add(self, row: str, branches: Sequence[Branch], prediction: Prediction) -> None:
        """Score one row's responses to the branches of a clip; `prediction` has them in order."""
        clip = prediction.clip
        self._frames[clip.split, clip.episode] = len(prediction.target)
        pairs = list(zip(branches, prediction.branches, strict=True))
        for kind in (ALL, *dict.fromkeys(branch.kind for branch in branches)):
            among = tuple(made for branch, made in pairs if kind in (ALL, branch.kind))
            part = replace(prediction, branches=among)
            for name, metric in self.metrics.items():
                with torch.autocast("cpu", enabled=False):
                    scored = *metric.scored(part), clip.episode, 0
                self._scores.setdefault((row, kind, name), []).append(scored)
        made = [Energies.of(prediction, *pair) for pair in pairs]
        self._energies.setdefault(row, []).extend(made)

    def summary(self) -> Counterfactual:
        """Summarise all responses that were added."""
        rows = list(self._energies)
        first = [each.branch for each in self._energies[rows[0]]] if rows else []
        kinds = list(dict.fromkeys(branch.kind for branch in first))
        parts = {
            kind: {row: decompose(self._of(row, kind)) for row in rows} for kind in (ALL, *kinds)
        }
        sizes = sorted({branch.size for branch in first})
        shifts = {(branch.kind, branch.size) for branch in first if branch.size}
        return Counterfactual(
            clips=len(self._frames),
            frames=max(self._frames.values(), default=0),
            branches=len(first),
            rows={row: self._estimates(row, ALL) for row in rows},
            kinds={kind: {row: self._estimates(row, kind) for row in rows} for kind in kinds},
            gain={kind: {row: each[0] for row, each in of.items()} for kind, of in parts.items()},
            residual={kind: {r: each[1] for r, each in of.items()} for kind, of in parts.items()},
            curves=[self._curve(k, size) for k in kinds for size in sizes if (k, size) in shifts],
        )

    def _of(self, row: str, kind: str, size: float | None = None) -> list[Energies]:
        return [
            each
            for each in self._energies[row]
            if kind in (ALL, each.branch.kind) and size in (None, each.branch.size)
        ]

    def _estimates(self, row: str, kind: str) -> dict[str, Estimate]:
        found: dict[str, Estimate] = {}
        for name, metric in self.metrics.items():
            values, weights, episodes, starts = np.array(self._scores[row, kind, name], float).T
            clips = np.stack([episodes, starts], 1).astype(np.int64)
            scores = ClipScores(values, weights, clips, summary_of(metric), bounds=metric.bounds)
            found[name] = scores.estimate(self.seed)
        return found

    def _curve(self, kind: str, size: float) -> ResponseCurve:
        same = {row: self._of(row, kind, size) for row in self._energies}
        sums = {row: pooled([each.sums for each in of]) for row, of in same.items()}
        first = next(iter(same))
        truth = np.sqrt(sums[first][0] / sum(each.values for each in same[first]))
        dimension = self.action.names.index(kind)
        return ResponseCurve(
            dimension=kind,
            unit=self.action.units[dimension],
            size=size,
            shift=float(np.mean([each.shift[dimension] for each in same[first]])),
            truth=truth.tolist(),
            rows={  # the part of the predicted response that lies along the true one
                row: [finite(value) for value in ratio(along, true) * truth]
                for row, (true, along, _) in sums.items()
            },
        )


def decompose(energies: Sequence[Energies]) -> tuple[float | None, float | None]:
    """Gain and residual of responses, see `Counterfactual`; None without a true response."""
    if not energies:
        return None, None
    true, along, predicted = pooled([each.sums for each in energies]).sum(1)
    if not true > 0:
        return None, None
    gain = along / true
    return finite(gain), finite(predicted / true - gain**2)


def pooled(sums: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The sum of arrays `[K, T]` with different numbers of frames T."""
    total = np.zeros((len(sums[0]), max(each.shape[1] for each in sums)))
    for each in sums:
        total[:, : each.shape[1]] += each
    return total


def ratio(value: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """`value / whole`; NaN where `whole` is not positive."""
    return np.divide(value, whole, out=np.full(len(whole), np.nan), where=whole > 0)
