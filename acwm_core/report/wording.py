"""Numbers and verdicts in words, for the report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from acwm_core.evaluation.results import Estimate, Paired, Summary

ROWS = {
    "truth": ("Truth itself", "the floor of whatever reads states from video"),
    "codec": ("Codec reconstruction", "the ceiling: the truth, encoded and decoded"),
    "perturbed": ("Simulator, perturbed", "started a millimetre off; few clips"),
    "model": ("Model, true actions", "what is being evaluated"),
    "shuffled": ("Model, other actions", "same model and noise, another episode’s actions"),
    "copy": ("First frame, copied", "a prediction in which nothing moves"),
}
"""Title and explanation of every row, in the order of tables."""

BESIDE = {
    "model": "Model",
    "truth": "Floor: truth",
    "codec": "Codec",
    "perturbed": "Perturbed",
    "shuffled": "Other actions",
    "copy": "First frame",
}
"""Short titles of the rows where they stand beside one another, the scores before their floors."""

PIXELS = ("mse", "m_mse", "ssim", "psnr", "psnr_mean", "lpips", "fvd")
"""Metrics that compare pixels, or features of them, with the truth; all others read states."""

THOUSANDTHS = ("mse", "m_mse")
"""Metrics that are always written in thousandths, as in the paper."""

SPLITS = {
    "train": "Training episodes",
    "ind_test": "In distribution",
    "ood_test": "Out of distribution",
}

OVER = {"copy": "copying the first frame", "shuffled": "the same model with other actions"}

CLEAR_SHARE = 0.1
"""Share of the way to the ceiling below which a real advantage is still called a beginning."""

MINUS = "−"
MISSING = "–"


@dataclass(frozen=True)
class Scale:
    """How the numbers of one metric are written.

    Attributes:
        factor: they are multiplied by it, 1 or 1000.
        decimals: digits after the point.
        unit: ``"dB"``, ``"mm"`` (of metres), ``"×10⁻³"`` or ``""``.
    """

    factor: float
    decimals: int
    unit: str

    @classmethod
    def of(cls, values: Iterable[float | None], unit: str) -> Scale:
        """One scale for numbers that stand together, with about three significant digits."""
        largest = max((abs(v) for v in values if v is not None), default=1.0)
        factor = 1000.0 if not unit and 0 < largest < 0.1 else 1.0
        if unit == "m":
            factor, unit = 1000.0, "mm"
        magnitude = math.floor(math.log10(largest * factor)) if largest else 0
        return cls(factor, min(3, max(0, 3 - magnitude)), unit or ("×10⁻³" if factor > 1 else ""))

    def number(self, value: float | None, *, signed: bool = False) -> str:
        """``24.31``, or ``+3.10`` and ``−0.42`` if signed."""
        if value is None:
            return MISSING
        text = f"{abs(value) * self.factor:.{self.decimals}f}"
        if value < 0 and float(text):
            return MINUS + text
        return f"+{text}" if signed else text

    def interval(self, estimate: Estimate, *, signed: bool = False) -> str:
        """``24.0 to 24.6``; empty without an interval."""
        if estimate.low is None or estimate.high is None:
            return ""
        low, high = (self.number(v, signed=signed) for v in (estimate.low, estimate.high))
        return f"{low} to {high}"


INITIALS = {"iou": "IoU", "psnr": "PSNR", "mse": "MSE", "ssim": "SSIM"}


def metric_title(name: str) -> str:
    """``M-MSE`` for ``m_mse``; longer names are words: ``Position error``, ``Mask IoU``."""
    if len(name) <= 5:
        return name.upper().replace("_", "-")
    title = " ".join(INITIALS.get(word, word) for word in name.split("_"))
    return title[0].upper() + title[1:]


def row_title(kind: str) -> str:
    """How a row is called."""
    return ROWS[kind][0] if kind in ROWS else kind


def split_title(split: str) -> str:
    """How a split is called."""
    return SPLITS.get(split, split)


def label_title(label: str | None) -> str:
    """``cube count 5 + friction`` for ``cube_count=5+friction``."""
    return (label or "").replace("_", " ").replace("=", " ").replace("+", " + ")


BRANCHES = {
    "factual": "Its own actions",
    "another": "Another episode’s actions",
    "still": "Nothing is moved",
    "reversed": "Actions reversed in time",
    "mirrored": "Actions mirrored",
}


def branch_title(name: str) -> str:
    """How a counterfactual branch is called; others shift one dimension of the action."""
    return BRANCHES.get(name, f"{name.replace('_', ' ')} shifted")


def gain(paired: Paired, higher_is_better: bool) -> Estimate:
    """The model's advantage over a reference: positive is better, whatever the metric."""
    difference = paired.difference
    if higher_is_better:
        return difference

    def negative(value: float | None) -> float | None:
        return None if value is None else -value

    return Estimate(negative(difference.value), negative(difference.high), negative(difference.low))


def gains(summary: Summary, split: str) -> dict[str, Estimate]:
    """The model's advantage in the headline metric over each reference."""
    info = summary.metrics[summary.headline]
    paired = summary.splits[split].scores.paired
    return {
        reference: gain(each[summary.headline], info.higher_is_better)
        for reference, each in paired.items()
    }


def metric_scale(summary: Summary, name: str) -> Scale:
    """One scale for all the rows of a metric, in all splits."""
    rows = [row for each in summary.splits.values() for row in each.scores.rows.values()]
    values = [row[name].value for row in rows if name in row]
    if name in THOUSANDTHS:
        thousand = [None if value is None else 1000 * value for value in values]
        return Scale(1000.0, Scale.of(thousand, "×10⁻³").decimals, "×10⁻³")
    return Scale.of(values, summary.metrics[name].unit)


def headline_scale(summary: Summary) -> Scale:
    """The scale of the headline metric's differences: one digit after the point for decibels."""
    info = summary.metrics[summary.headline]
    values = [
        rows["model"][summary.headline].value
        for rows in (each.scores.rows for each in summary.splits.values())
    ]
    scale = Scale.of(values, info.unit)
    return Scale(scale.factor, max(1, scale.decimals - 1), scale.unit)


def protocol_text(summary: Summary) -> str:
    """Which clips were predicted, and how: ``first 20 frames of each test episode, 5 sampling …``.

    Where not all episodes were taken, it says how many of each split.
    """
    facts = summary.provenance
    settings, there = facts["evaluation"], facts["dataset"]["episodes"]
    taken = {
        split: each.scores.episodes or each.scores.clips for split, each in summary.splits.items()
    }
    counts = ", ".join(f"{n} of {there[split]} {split}" for split, n in taken.items())
    some = any(n < there[split] for split, n in taken.items())
    episodes = f"chosen episode ({counts})" if some else "test episode"
    if summary.protocol != "full":
        clips = f"{settings['cuts']} windows of {settings['frames']} frames of each {episodes}"
    elif settings["frames"]:
        clips = f"first {settings['frames']} frames of each {episodes}"
    else:
        clips = f"the whole of each {episodes}"
    return f"{clips}, {facts['sampling_steps']} sampling steps, seed {settings['seed']}"


def floor_text(summary: Summary) -> str:
    """Of which true frames the floors are: ``the true frames of the first 8 episodes``."""
    few: int | None = summary.provenance["evaluation"].get("noise_floor_episodes")
    taken = [each.scores.episodes or each.scores.clips for each in summary.splits.values()]
    if few is None or few >= max(taken):
        return "the true frames"
    return f"the true frames of the first {few} episodes"


def verdict_title(summary: Summary) -> str:
    """One line: whether the model predicts, and whether it listens to its actions."""
    split = next(iter(summary.splits))
    advantage = gains(summary, split)
    moves, listens = ((advantage[reference].low or 0) > 0 for reference in ("copy", "shuffled"))
    if moves and listens:
        if min(_share(summary, split, reference) for reference in OVER) < CLEAR_SHARE:
            return "It begins to predict what the actions do."
        return "It predicts what the actions do."
    if listens:
        return "It listens to the actions, but a still picture comes closer to the truth."
    if moves:
        return "It predicts better than a still picture, but not from the actions."
    return "It does not predict yet."


def _share(summary: Summary, split: str, reference: str) -> float:
    """How much of the way from a reference to the codec's ceiling the model has gone."""
    rows = summary.splits[split].scores.rows
    low, reached, ceiling = (
        rows[kind][summary.headline].value for kind in (reference, "model", "codec")
    )
    if low is None or reached is None or ceiling is None or ceiling == low:
        return 1.0  # nothing is left to be gained, or to be measured
    return (reached - low) / (ceiling - low)


def verdict(summary: Summary) -> list[str]:
    """Sentences in plain words with the figures, one split after the other."""
    return [_verdict_of_split(summary, split) for split in summary.splits]


def _verdict_of_split(summary: Summary, split: str) -> str:
    name, scale = metric_title(summary.headline), headline_scale(summary)
    scores = summary.splits[split].scores
    value = scale.number(scores.rows["model"][summary.headline].value)
    advantage = gains(summary, split)
    pair = scores.paired["shuffled"][summary.headline]
    if split != next(iter(summary.splits)):
        return (
            f"{split_title(split)}, {name} is {_with_unit(value, scale)}: "
            f"{_better(advantage['copy'], scale)} than {OVER['copy']}, "
            f"{_better(advantage['shuffled'], scale)} than {OVER['shuffled']}, and the true "
            f"actions win {pair.better} of {pair.clips} episodes."
        )
    return (
        f"{split_title(split)}, {name} with the true actions is {_with_unit(value, scale)}. "
        f"Episode by episode that is {_better(advantage['copy'], scale)} than {OVER['copy']} and "
        f"{_better(advantage['shuffled'], scale)} than {OVER['shuffled']}; the true actions win "
        f"{pair.better} of {pair.clips} episodes."
    )


def _better(advantage: Estimate, scale: Scale) -> str:
    if advantage.value is None:
        return "incomparably better"
    number = scale.number(abs(advantage.value))
    if not float(number):
        return "no better"
    return f"{_with_unit(number, scale)} {'worse' if advantage.value < 0 else 'better'}"


def _with_unit(number: str, scale: Scale) -> str:
    return f"{number} {scale.unit}".strip()
