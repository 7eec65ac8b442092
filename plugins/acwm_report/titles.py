"""Titles of splits, rows, baselines and branches of an evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from acwm_core.evaluation.results import SetSummary

SPLITS = {
    "train": "Training episodes",
    "ind_test": "In distribution",
    "ood_test": "Out of distribution",
}
"""Titles of the splits."""


class RowTitle(NamedTuple):
    """What a row of an evaluation is called."""

    title: str  # of a line in a table
    short: str  # of a column, and on the terminal
    about: str
    over: str = ""  # of a baseline that the model is compared with on each clip: what it is


ROWS = {
    "truth": RowTitle("True video", "noise floor", "noise floor: the estimator’s own error"),
    "codec": RowTitle(
        "Codec reconstruction", "codec alone", "upper bound: the truth, encoded and decoded"
    ),
    "perturbed": RowTitle(
        "Simulator, perturbed", "other start", "started a millimetre off; few clips"
    ),
    "model": RowTitle("Model, true actions", "model", "the evaluated model"),
    "mean_of_draws": RowTitle(
        "Model, mean of draws", "mean frames", "mean frames; uncertain parts are blurred"
    ),
    "best_of_draws": RowTitle(
        "Model, best of draws", "best draw", "the best draw of each clip in each metric"
    ),
    "shuffled": RowTitle(
        "Model, other actions",
        "other actions",
        "same model and noise, another episode’s actions",
        "the same model with other actions",
    ),
    "copy": RowTitle(
        "First frame, repeated", "first frame", "nothing moves", "the repeated first frame"
    ),
}
"""The names of every row of an evaluation, in table order."""


COLUMNS = (
    *("model", "mean_of_draws", "best_of_draws"),
    *("truth", "codec", "perturbed", "shuffled", "copy"),
)
"""The order of rows where they are table columns: the scores first, then their bounds."""


ENSEMBLE_ROWS = {
    "simulator": ("Simulator", "floor: one half of its futures against the other"),
    "codec": (ROWS["codec"].title, "of the simulator’s futures: lower bound on this codec"),
    "model": ("Model", ROWS["model"].about),
    "copy": (ROWS["copy"].title, ROWS["copy"].about),
}
"""Title and explanation of what is compared with the simulator's futures, in table order."""


OVER = {name: ROWS[name].over for name in ("copy", "shuffled")}
"""The baselines that a model is compared with on each clip."""


BRANCHES = {
    "factual": "Its own actions",
    "another": "Another episode’s actions",
    "still": "No motion",
    "reversed": "Actions reversed in time",
    "mirrored": "Actions mirrored",
}
"""Titles of counterfactual branches; all other branches shift one action dimension."""


def counted(count: int, noun: str) -> str:
    """A number with its noun: ``1 clip``, ``2 clips``, ``3 branches``, ``1,000 episodes``."""
    ending = "es" if noun.endswith(("s", "x", "ch", "sh")) else "s"
    return f"{count:,} {noun}{ending * (count != 1)}"


def split_title(split: str) -> str:
    """The title of a split."""
    return SPLITS.get(split, split)


def label_title(label: str | None) -> str:
    """A label in words: ``cube count 5 + friction`` for ``cube_count=5+friction``."""
    return (label or "").replace("_", " ").replace("=", " ").replace("+", " + ")


def branch_title(name: str) -> str:
    """The title of a counterfactual branch."""
    return BRANCHES.get(name, f"{name.replace('_', ' ')} shifted")


def clips_title(scores: SetSummary) -> str:
    """The number of clips in words: ``12 episodes``, or ``120 clips of 12 episodes``."""
    if scores.episodes in (0, scores.clips):
        return counted(scores.clips, "episode")
    return f"{counted(scores.clips, 'clip')} of {counted(scores.episodes, 'episode')}"


def short_title(row: str) -> str:
    """The short name of a row of an evaluation, as ``codec alone``."""
    return ROWS[row].short if row in ROWS else row
