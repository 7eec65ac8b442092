"""The datasets and trainings that an experiment needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from acwm_core.recipe import Recipe
from acwm_experiment.files import DataChoice


@dataclass(frozen=True)
class DatasetSpec:
    """A dataset to train and test on."""

    path: Path  # its folder
    environment: str  # the environment to simulate
    choice: DataChoice  # how to simulate it if the dataset does not exist


@dataclass(frozen=True)
class RunSpec:
    """One training and its evaluation."""

    folder: Path  # the run folder
    title: str  # readable name of the cell and seed
    arguments: tuple[str, ...]  # recipe and overrides for `acwm fit`
    recipe: Recipe  # the recipe composed from them
    # the dataset that it needs; None for the user's own data or data behind a URL
    dataset: DatasetSpec | None

    @property
    def max_steps(self) -> int:
        """The number of optimiser steps of the training."""
        return self.recipe.trainer["max_steps"]

    @property
    def gpus(self) -> int:
        """The number of GPUs per node in the recipe; 0 if it gives no number."""
        accelerator, devices = (self.recipe.trainer.get(k) for k in ("accelerator", "devices"))
        return max(devices, 0) if accelerator in ("gpu", "cuda") and isinstance(devices, int) else 0
