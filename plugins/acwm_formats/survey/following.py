"""Whether a video follows its actions, and with what delay.

Actions are read from the changes of frames by ridge regression, in episodes that the regression has
not seen. Since consecutive actions are similar, and a policy responds to what it sees, a change
also carries information about actions before and after the one that caused it. The delay is
therefore measured on the part of an action that earlier actions and earlier frames do not predict.
The first change that carries information about this part is the one that the action caused.

Each reading is compared with one from another episode's frames at the same time. Episodes whose
actions were exchanged, or that all do the same at the same time, therefore show nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from acwm_formats.survey.motion import GRIDS, Floats, motion, poses
from acwm_formats.survey.regression import Numbers, gains, residuals, standard

SHIFTS = 5  # frames in either direction
BEFORE = 2  # earlier actions and changes that foretell an action
FEWEST = 4  # episodes, or stretches of fewer ones
CERTAIN = 1e-3  # chance, over all shifts, below which something is taken to follow
LIKELY = 2.5  # standard errors from which a reading may be more than chance
LEAST = 0.02  # share of the actions below which a reading is not worth the name
NOTABLE = 0.1  # share of the largest reading from which a shift counts as seen
STILL = 1e-5  # share of an action's variance below which what is new in it is rounding
OTHERS = 3  # stretches that each is compared with
RESAMPLES = 1000


@dataclass(frozen=True)
class Moments:
    """A stretch made small.

    Attributes:
        episode: what tells its episode from others.
        start: its first frame in the episode.
        frames: ``[T, 3, h, w]`` in [0, 1], see `motion.small`.
        actions: ``[T − 1, A]``.
    """

    episode: tuple[str, int]
    start: int
    frames: Floats
    actions: Floats


@dataclass(frozen=True)
class Following:
    """How far a video follows its actions.

    Attributes:
        shifts: the delays that were tried, in frames.
        explained: for each, the share of what is new in an action that the change of frames tells;
            the mean over actions, weighted by how well they are read.
        read: the share of each action's variance that can be read from the frames; NaN if the
            action is constant.
        follows: whether more can be read than from another episode's frames.
        delay: frames from an action to the change that it makes; None if nothing follows, or if
            actions change too steadily to tell.
        confidence: share of resamples of the episodes that give the same delay; 0 without one.
        episodes: number of episodes that were looked at.
    """

    shifts: tuple[int, ...]
    explained: tuple[float, ...]
    read: tuple[float, ...]
    follows: bool
    delay: int | None
    confidence: float
    episodes: int


def following(moments: Sequence[Moments]) -> Following | None:
    """Estimate it; None if episodes are too few or too short, or no action ever changes."""
    if not moments:
        return None
    longest = float(np.median([len(stretch.actions) for stretch in moments]))
    reach = int(min(SHIFTS, (longest - BEFORE - 4) // 2))
    fit = [stretch for stretch in moments if len(stretch.actions) >= 2 * reach + BEFORE + 4]
    varies = varying(fit)
    if reach < 1 or len(fit) < FEWEST or not varies.any():
        return None
    seen = Seen(fit, varies, reach)
    shifts = tuple(range(-reach, reach + 1))
    plain = np.stack([seen.plain(shift) for shift in shifts])  # [shift, action, group]
    new = np.stack([seen.new(shift) for shift in shifts])
    best = np.clip(plain.mean(2).max(0), 0, 1)
    weights = best / max(best.sum(), 1e-12)
    explained = np.einsum("sag,a->sg", new, weights)
    follows = any(_shown(rows) for rows in (np.einsum("sag,a->sg", plain, weights), explained))
    delay, confidence = _delay(explained, shifts) if follows else (None, 0.0)
    read = np.full(len(varies), np.nan)
    read[varies] = best
    means = tuple(explained.mean(1).tolist())
    count = len({stretch.episode for stretch in fit})
    return Following(shifts, means, tuple(read.tolist()), follows, delay, confidence, count)


def varying(moments: Sequence[Moments]) -> NDArray[np.bool_]:
    """Which actions ever change, ``[A]``."""
    every = np.concatenate([stretch.actions for stretch in moments])
    return every.std(0) > 1e-6 * np.maximum(np.abs(every).max(0), 1e-12)


class Seen:
    """Rows of all stretches, one for each frame from which all shifts stay within the stretch."""

    def __init__(
        self,
        moments: Sequence[Moments],
        varies: NDArray[np.bool_],
        reach: int,
    ) -> None:
        self.rows = [np.arange(reach + BEFORE, len(m.actions) - reach) for m in moments]
        self.actions = standard([m.actions[:, varies].astype(np.float64) for m in moments])
        changes = standard([motion(m.frames).astype(np.float64) for m in moments])
        places = standard([p.astype(np.float64) for p in poses([m.frames for m in moments])])
        whole = 3 * GRIDS[0] ** 2
        turned = [  # the same motion is seen differently elsewhere
            (c[:, :whole, None] * p[:-1, None]).reshape(len(c), -1)
            for c, p in zip(changes, places, strict=True)
        ]
        both = [np.concatenate(pair, 1) for pair in zip(changes, turned, strict=True)]
        self.change = standard([b[r] for b, r in zip(both, self.rows, strict=True)])
        self.place = [p[r] for p, r in zip(places, self.rows, strict=True)]
        self.past = [
            np.concatenate([_clock(m.start + r), p, b[r - 1], c[r - 2]], 1)
            for p, b, c, m, r in zip(self.place, both, changes, moments, self.rows, strict=True)
        ]
        self.groups = _groups(moments)
        self.others = _others(moments, self.groups)

    def plain(self, shift: int) -> Numbers:
        """How well the actions `shift` frames before are read, ``[action, group]``."""
        ones = [np.ones((len(change), 1)) for change in self.change]
        inputs = [np.concatenate(pair, 1) for pair in zip(self.change, self.place, strict=True)]
        return gains(ones, inputs, standard(self._actions(shift)), self.groups, self.others)

    def moved(self, shift: int) -> Numbers:
        """How well they are read by changes beyond what the picture tells, ``[action, group]``."""
        known = [np.concatenate([np.ones((len(place), 1)), place], 1) for place in self.place]
        return gains(known, self.change, standard(self._actions(shift)), self.groups, self.others)

    def new(self, shift: int) -> Numbers:
        """How well what was new in them is read, ``[action, group]``."""
        earlier = [self._actions(shift + back) for back in range(1, BEFORE + 1)]
        known = [np.concatenate(parts, 1) for parts in zip(self.past, *earlier, strict=True)]
        actions = self._actions(shift)
        count = actions[0].shape[1]
        both = [np.concatenate(pair, 1) for pair in zip(actions, self.change, strict=True)]
        left = residuals(known, both, self.groups)
        news = [rows[:, :count] for rows in left]
        moved = np.concatenate(news).var(0) > STILL * np.concatenate(actions).var(0)
        changes = standard([rows[:, count:] for rows in left])
        shares = gains(known, changes, standard(_cut(news)), self.groups, self.others)
        return np.where(moved[:, None], shares, 0)

    def _actions(self, shift: int) -> list[Numbers]:
        return [a[r - shift] for a, r in zip(self.actions, self.rows, strict=True)]


def _clock(frames: NDArray[np.int64]) -> Numbers:
    """Powers of the time, for what happens at the same time in every episode."""
    time = frames[:, None] / 64
    return np.concatenate([time**0, time, time**2], 1)


def _cut(rows: Sequence[Numbers]) -> list[Numbers]:
    """Cut rare jumps, such as a policy's change of plan, to three times of what is common."""
    every = np.concatenate(rows)
    common = 1.4826 * np.median(np.abs(every), 0)
    most = 3 * np.maximum(common, 0.2 * every.std(0))
    return [np.clip(values, -most, most) for values in rows]


def _groups(moments: Sequence[Moments]) -> NDArray[np.int64]:
    """The number of each stretch's episode; of the stretch itself if episodes are too few."""
    names = list(dict.fromkeys(stretch.episode for stretch in moments))
    if len(names) < FEWEST:
        return np.arange(len(moments))
    return np.array([names.index(stretch.episode) for stretch in moments])


def _others(moments: Sequence[Moments], groups: NDArray[np.int64]) -> list[list[int]]:
    """For each stretch, those of other groups that begin most nearly at the same time."""
    starts, order = np.array([stretch.start for stretch in moments]), np.arange(len(moments))
    others: list[list[int]] = []
    for index in order:
        strangers = np.roll(order, -index)[1:]
        strangers = strangers[groups[strangers] != groups[index]]
        gap = np.abs(starts[strangers] - starts[index])
        others.append(strangers[np.argsort(gap, kind="stable")[:OTHERS]].tolist())
    return others


def _shown(values: Numbers) -> bool:
    """Whether some row of ``[shift, group]`` is above zero, by more than chance and notably."""
    return bool(((_sizes(values) > _limit(values)) & (values.mean(1) > LEAST)).any())


def _delay(explained: Numbers, shifts: Sequence[int]) -> tuple[int | None, float]:
    """The first change that notably predicts an action, in most resamples, and their share.

    It begins the run of such changes that contains the best predictor: the frames to which a policy
    responds predict its actions, too, but are not caused by them. What is merely likely counts as
    well, so a delay is uncertain if an earlier change may also be a predictor.
    """
    early = [shift < 0 for shift in shifts]
    above = explained - np.median(explained[early], 0)  # what the regression finds in nothing
    certain = _sizes(above) > _limit(above)
    if not certain.any():
        return None, 0.0
    notable = NOTABLE * above.mean(1)[certain].max()
    picks = np.random.default_rng(0).integers(
        explained.shape[1], size=(RESAMPLES, explained.shape[1])
    )
    again = above[:, picks]
    means = again.mean(2)
    starts = _starts((_sizes(again) > LIKELY) & (means >= notable), means)
    counts = np.bincount(starts + 1, minlength=2)[1:]
    return shifts[int(counts.argmax())], float(counts.max()) / RESAMPLES


def _starts(seen: NDArray[np.bool_], means: Numbers) -> NDArray[np.int64]:
    """Where the run of seen shifts begins that holds the largest mean, by column; −1 if none is."""
    order = np.arange(len(seen))[:, None]
    peak = np.where(seen, means, -np.inf).argmax(0)
    gap = np.where(seen | (order > peak), -1, order).max(0)
    return np.where(seen.any(0), gap + 1, -1)


def _sizes(values: Numbers) -> Numbers:
    """Means over the last axis in standard errors."""
    error = values.std(-1, ddof=1) / np.sqrt(values.shape[-1])
    return values.mean(-1) / np.maximum(error, 1e-12)


def _limit(values: Numbers) -> float:
    """The size that the largest row of ``[shift, group]`` reaches by chance with `CERTAIN`."""
    return float(stats.t.isf(CERTAIN / len(values), values.shape[1] - 1))
