"""The public Python API, for scripts and notebooks. docs/python.md shows a whole training loop.

    import acwm

    env = acwm.make_env("push_cube", task="place")        # a Gymnasium environment
    run = acwm.load("runs/mine")                          # recipe, card and world model
    episodes = acwm.EpisodeDataset("data/push_cube", "train")

Importing acwm registers every installed environment with Gymnasium as ``acwm/NAME-v0``, so
``gymnasium.make("acwm:acwm/push_cube-v0")`` needs no other import. Registering on import is the
convention since Gymnasium 1.0 removed its entry points. Everything else is imported on first use:
``import acwm`` takes half a second, and torch is imported only by what needs it.
"""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, overload

import gymnasium

from acwm_core import __version__
from acwm_core.plugins import catalog

if TYPE_CHECKING:
    from acwm_core.data.card import DatasetCard
    from acwm_core.data.clips import ClipDataset
    from acwm_core.data.dataset import EpisodeDataset
    from acwm_core.data.generate import generate
    from acwm_core.env.environment import Environment
    from acwm_core.env.task import Task, TaskEnvironment
    from acwm_core.errors import AcwmError
    from acwm_core.model.build import build_world_model
    from acwm_core.model.world_model import WorldModel
    from acwm_core.recipe import Recipe, compose
    from acwm_core.training.fit import fit
    from acwm_core.training.run import load_run as load
    from acwm_interventions.evaluate import evaluate_run as evaluate
    from acwm_planning.planner import Planner

__all__ = [
    "AcwmError",
    "ClipDataset",
    "EpisodeDataset",
    "Recipe",
    "WorldModel",
    "__version__",
    "build_world_model",
    "compose",
    "evaluate",
    "fit",
    "generate",
    "load",
    "make_env",
    "make_planner",
    "make_task",
    "register",
    "save",
]

_HOMES = {
    "AcwmError": "acwm_core.errors:AcwmError",
    "ClipDataset": "acwm_core.data.clips:ClipDataset",
    "EpisodeDataset": "acwm_core.data.dataset:EpisodeDataset",
    "Recipe": "acwm_core.recipe:Recipe",
    "WorldModel": "acwm_core.model.world_model:WorldModel",
    "build_world_model": "acwm_core.model.build:build_world_model",
    "compose": "acwm_core.recipe:compose",
    "evaluate": "acwm_interventions.evaluate:evaluate_run",
    "fit": "acwm_core.training.fit:fit",
    "generate": "acwm_core.data.generate:generate",
    "load": "acwm_core.training.run:load_run",
}
"""Public names that are imported on first use, and where each is defined."""


DREAM = "acwm/dream-v0"
"""The Gymnasium id of the environment that is made of a world model."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        here = sys.modules[__name__]
        raise AttributeError(f"module 'acwm' has no attribute {name!r}", name=name, obj=here)
    globals()[name] = found = resolve_name(_HOMES[name])
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def register() -> None:
    """Register all environments of the catalog that have no Gymnasium id yet; imports none."""
    for component in catalog().registry("environment"):
        name = f"acwm/{component.name}-v0"
        if name not in gymnasium.registry:
            # Environments truncate themselves at their card's horizon, so no TimeLimit is needed.
            gymnasium.register(id=name, entry_point=functools.partial(_make, component.name))
    if DREAM not in gymnasium.registry:
        gymnasium.register(
            id=DREAM,
            entry_point="acwm_dream.environment:Dream",
            vector_entry_point="acwm_dream.vector:DreamVector",
        )


@overload
def make_env(name: str, *, task: None = None, **params: Any) -> Environment: ...


@overload
def make_env(name: str, *, task: str, **params: Any) -> TaskEnvironment: ...


def make_env(name: str, *, task: str | None = None, **params: Any) -> Environment | TaskEnvironment:
    """Create the Gymnasium environment `name`; `acwm list environment` shows the names.

    Args:
        task: one of its tasks; it then defines the reward and when an episode ends.
        **params: constructor arguments, such as ``size=64`` for frames `[64, 64, 3]`.

    Raises:
        RecipeError: no such environment or task.
        MissingExtraError: its simulator is not installed.
    """
    return _make(name, task=task, **params)


def make_task(environment: str, name: str) -> Task:
    """Load a task, which measures how far a state is from a goal. It needs no simulator.

    Raises:
        RecipeError: no such environment or task.
    """
    return catalog().component("environment", environment).load_task(name)


def make_planner(name: str, **params: Any) -> Planner:
    """Create the planner `name`, which searches for the actions with the lowest cost.

    Args:
        name: one of `acwm list planner`.
        **params: constructor arguments, such as ``horizon=5``.

    Raises:
        RecipeError: no such planner.
    """
    from acwm_planning.planner import Planner  # imports torch

    return catalog().component("planner", name).create_as(Planner, **params)


def save(
    path: Path | str, recipe: Recipe, card: DatasetCard, world_model: WorldModel, *, step: int = 0
) -> Path:
    """Save a world model that you trained in your own loop as a run folder.

    `load`, `acwm evaluate` and all other commands accept it like any run.

    Args:
        path: the run folder to create.
        recipe: the recipe that the world model was built from.
        card: the card of the training dataset, `EpisodeDataset.card`.
        step: number of optimiser steps the weights were trained for.

    Raises:
        AcwmError: the folder already holds a run.
    """
    from acwm_core.errors import TrainingError
    from acwm_core.files import written_whole
    from acwm_core.training.run import save_weights  # imports torch
    from acwm_core.training.run_folder import RunFolder

    run = RunFolder(path)
    if run.recipe.exists():
        raise TrainingError(f"{run.path} holds a run already: choose another folder")
    run.path.mkdir(parents=True, exist_ok=True)
    codec = world_model.codec.fingerprint()
    save_weights(run.weights, world_model.state_dict(), codec, step)
    card.write(run.path)
    with written_whole(run.recipe) as partial:
        partial.write_text(recipe.to_yaml(), encoding="utf-8")
    return run.path


def _make(name: str, *, task: str | None = None, **params: Any) -> Any:
    component = catalog().component("environment", name)
    if task is None:
        return component.create(**params)
    from acwm_core.env.task import TaskEnvironment

    return TaskEnvironment(component.create(**params), component.load_task(task))


register()
