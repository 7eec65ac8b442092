"""What splits, rows, baselines and branches of an evaluation are called on a page."""

from __future__ import annotations

from acwm_core.evaluation.results import SetSummary

SPLITS = {
    "train": "Training episodes",
    "ind_test": "In distribution",
    "ood_test": "Out of distribution",
}
"""Titles of the splits."""


ROWS = {
    "truth": ("True video", "the noise floor: the error of the estimator of states"),
    "codec": ("Codec reconstruction", "the ceiling: the truth, encoded and decoded"),
    "perturbed": ("Simulator, perturbed", "started a millimetre off; few clips"),
    "model": ("Model, true actions", "what is being evaluated"),
    "mean_of_draws": ("Model, mean of its draws", "the mean frames; what is unsure is a haze"),
    "best_of_draws": ("Model, best of its draws", "in each metric the best draw of each clip"),
    "shuffled": ("Model, other actions", "same model and noise, another episode’s actions"),
    "copy": ("First frame, copied", "a prediction in which nothing moves"),
}
"""Title and explanation of every row of an evaluation, in table order."""


BESIDE = {
    "model": "Model",
    "mean_of_draws": "Mean of draws",
    "best_of_draws": "Best of draws",
    "truth": "Noise floor",
    "codec": "Codec",
    "perturbed": "Perturbed",
    "shuffled": "Other actions",
    "copy": "First frame",
}
"""Short titles of the rows where they are table columns: the scores first, then their floors."""


ENSEMBLE_ROWS = {
    "simulator": ("Simulator", "the floor: one half of its futures against the other"),
    "codec": ("Codec reconstruction", "of the simulator’s futures: the least with this codec"),
    "model": ("Model", "what is being evaluated"),
    "copy": ("First frame, copied", "a future in which nothing moves"),
}
"""Title and explanation of what is compared with the simulator's futures, in table order."""


OVER = {"copy": "the copied first frame", "shuffled": "the same model with other actions"}
"""The baselines that a model is compared with on each clip."""


BRANCHES = {
    "factual": "Its own actions",
    "another": "Another episode’s actions",
    "still": "Nothing is moved",
    "reversed": "Actions reversed in time",
    "mirrored": "Actions mirrored",
}
"""Titles of counterfactual branches; all other branches shift one action dimension."""


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
        return f"{scores.clips} episodes"
    return f"{scores.clips} clips of {scores.episodes} episodes"
