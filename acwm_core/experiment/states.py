"""What is done of an experiment, told by the results themselves, whoever made them."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.episode import SPLITS, Split
from acwm_core.errors import DataError, TrainingError
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.experiment.folder import SUMMARY, ExperimentFolder
from acwm_core.experiment.plan import Dataset, Run
from acwm_core.recipe import Recipe, recipe_differences

WEIGHTS, RECIPE = "model.safetensors", "recipe.yaml"
"""Files of a run folder (`acwm_core.training.run.RunFolder` needs torch)."""


@dataclass(frozen=True)
class State:
    """How far something is.

    Attributes:
        done: nothing is left to do.
        share: of the work that is done, in [0, 1].
    """

    done: bool
    share: float = 0.0


NOTHING, ALL = State(False), State(True, 1.0)


def dataset_state(dataset: Dataset) -> State:
    """How far a dataset is.

    Raises:
        DataError: its folder holds another one, or none that can be read.
    """
    if not (dataset.path / CARD).is_file():
        return NOTHING
    card = DatasetCard.read(dataset.path)
    differences = list(_differences(dataset, card))
    if differences:
        raise DataError(
            f"{dataset.path} holds another dataset than the experiment asks for: "
            f"{'; '.join(differences)}; set data.path to another folder, or delete it"
        )
    wanted = _counts(dataset, card) or card.splits
    return ALL if all(split in card.checksums for split in wanted) else NOTHING


def _differences(dataset: Dataset, card: DatasetCard) -> Iterable[str]:
    choice, there = dataset.choice, card.environment
    if there.name != dataset.environment:
        yield f"it is of {there.name}, not {dataset.environment}"
    if choice.size and choice.size != there.frame_size:
        yield f"frames are {_times(there.frame_size)}, not {_times(choice.size)}"
    if card.source:
        return
    if card.seed != choice.seed:
        yield f"its seed is {card.seed}, not {choice.seed}"
    if card.factors:
        yield f"factors are overridden ({', '.join(card.factors)})"
    for split, count in _counts(dataset, card).items():
        made = card.splits.get(split)
        if made not in (None, count):
            yield f"{split} has {made} episodes, not {count}"


def _counts(dataset: Dataset, card: DatasetCard) -> dict[Split, int]:
    """The episodes per split that there should be; empty if that is open."""
    if card.source:  # recorded: what there is
        return {}
    usual = tuple(card.environment.episodes.get(split, 0) for split in SPLITS)
    pairs = zip(SPLITS, dataset.choice.episodes or usual, strict=True)
    return {split: count for split, count in pairs if count}


def _times(size: Iterable[int]) -> str:
    return "×".join(map(str, size))


def training_state(run: Run) -> State:
    """How far a training is.

    Raises:
        TrainingError: the run folder holds another run.
    """
    if not (run.folder / RECIPE).is_file():
        return NOTHING
    differences = recipe_differences(_recipe(run.folder / RECIPE), run.recipe)
    steps = saved_steps(run.folder)
    if steps > run.max_steps:
        differences.append(f"trainer.max_steps was {steps}, is {run.max_steps}")
    if differences:
        raise TrainingError(
            f"{run.folder} holds another run than the experiment asks for: "
            f"{'; '.join(differences)}; choose another --out, or delete it"
        )
    return State(steps == run.max_steps, steps / run.max_steps)


@functools.cache
def _recipe(file: Path) -> Recipe:
    """A run's recipe, which stays what it is."""
    return Recipe.from_yaml(file)


def saved_steps(run: Path) -> int:
    """Optimiser steps behind the weights of a run folder; 0 without any that can be read."""
    import safetensors

    opened = cast(Any, safetensors).safe_open
    try:
        with opened(run / WEIGHTS, framework="np") as file:
            metadata: dict[str, str] = file.metadata() or {}
        return int(json.loads(metadata["acwm"])["step"])
    except (OSError, safetensors.SafetensorError, KeyError, ValueError):
        return 0


def evaluation_state(run: Run) -> State:
    """Whether the weights of a finished run were evaluated as its recipe says now."""
    summary, weights = run.folder / SUMMARY, run.folder / WEIGHTS
    try:
        found: Mapping[str, Any] = json.loads(summary.read_text(encoding="utf-8"))["provenance"]
        newer = summary.stat().st_mtime_ns >= weights.stat().st_mtime_ns
        settings = {**EvaluationConfig().to_dict(), **found["evaluation"]}  # some may be new
        same = settings == EvaluationConfig(**run.recipe.evaluation).to_dict()
        return ALL if newer and same and found["training_steps"] == run.max_steps else NOTHING
    except (OSError, ValueError, KeyError, TypeError):
        return NOTHING


def evaluation_overrides(run: Run) -> list[str]:
    """What `acwm evaluate` is told, so that a run trained before is evaluated as asked for now.

    Its own recipe may say something else, if only what was usual when it was trained.
    """
    wanted = EvaluationConfig(**run.recipe.evaluation).to_dict()
    overrides = setting_overrides(EvaluationConfig().to_dict(), wanted)
    if (run.folder / RECIPE).is_file():
        trained = _recipe(run.folder / RECIPE).evaluation
        overrides += setting_overrides(
            {name: trained[name] for name in trained if name in wanted}, wanted
        )
    return list(dict.fromkeys(overrides))


def report_state(folder: ExperimentFolder, runs: Iterable[Run]) -> State:
    """Whether the report is newer than everything that it shows."""
    shown = [folder.file, *(run.folder / SUMMARY for run in runs)]
    newest = max((path.stat().st_mtime_ns for path in shown if path.exists()), default=0)
    written = folder.report.exists() and folder.report.stat().st_mtime_ns >= newest
    return ALL if written else NOTHING
