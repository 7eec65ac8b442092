"""Worlds that can be played: a run with the simulator of its environment."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.env.task import Task
from acwm_core.errors import RecipeError, TrainingError
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from acwm_core.training.run_folder import RunFolder, find_run, trained_models


@dataclass(frozen=True)
class World:
    """An entry of the menu.

    Attributes:
        name: name of the run, unique in the menu.
        run: folder of the run, or name of a trained model.
        environment: registered name of the simulator; of recorded data just a name.
        size: height and width of frames.
        data: data folder whose video is shown instead, if there is no simulator.
    """

    name: str
    run: str | Path
    environment: str
    size: tuple[int, int]
    data: Path | None = None


def playable(
    runs: Sequence[Path],
    *,
    environment: str | None = None,
    frame_size: int | tuple[int, int] | None = None,
) -> list[World]:
    """The given runs and the installed trained models; the first one is played first.

    A run without a simulator is played beside the recorded video of its data.

    Args:
        runs: run folders.
        environment: environment for the given runs, or, without runs, of the trained model that
            comes first; that of their data by default.
        frame_size: a side, or height and width; those of their data by default.

    Raises:
        RecipeError: there is no such environment.
        TrainingError: there is nothing to play; the message says what to do.
        RecipeError: a run has neither the simulator of its environment nor its data.
    """
    if environment:
        _ = catalog().component("environment", environment)
    given = [_world(run, run, environment, frame_size) for run in runs]
    installed = [_world(name, find_run(name), None, frame_size) for name in trained_models()]
    if environment:
        installed.sort(key=lambda world: world.environment != environment)
    simulators = catalog().registry("environment")
    worlds = [*given, *(world for world in installed if world.environment in simulators)]
    if not given and (not worlds or environment not in (None, worlds[0].environment)):
        what = f"of {environment} " if environment else ""
        raise TrainingError(
            f"no trained model {what}is installed: train one, as `acwm demo` does, and name its "
            "run, as in `acwm play runs/demo/run`"
        )
    worlds = [
        world if world.environment in simulators else _beside_recording(world) for world in worlds
    ]
    return [
        dataclasses.replace(world, name=name) for name, world in _by_unique_name(worlds).items()
    ]


def tasks_of(environment: str) -> dict[str, Task]:
    """The tasks of a world by name, without those that cannot be loaded."""
    if environment not in catalog().registry("environment"):  # it is recorded
        return {}
    component = catalog().component("environment", environment)
    tasks: dict[str, Any] = {}
    for name in component.tasks:
        with contextlib.suppress(Exception):  # whatever a plugin raises
            tasks[name] = component.load_task(name)
    return {name: task for name, task in tasks.items() if isinstance(task, Task)}


def _beside_recording(world: World) -> World:
    data = Path(str(Recipe.from_yaml(RunFolder(Path(world.run)).recipe).data["path"]))
    if not (data / CARD).exists():
        raise RecipeError(
            f"no simulator of {world.environment}, the world of {world.run}, is installed, and "
            f"there is no dataset in {data} whose video could be shown: choose another world with "
            "--env"
        )
    return dataclasses.replace(world, data=data)


def _world(
    run: str | Path,
    folder: Path,
    environment: str | None,
    frame_size: int | tuple[int, int] | None,
) -> World:
    card = DatasetCard.read(RunFolder(folder).card).environment
    size = (frame_size, frame_size) if isinstance(frame_size, int) else frame_size
    if isinstance(frame_size, int):  # a single side is the height, as everywhere in acwm
        size = (frame_size, 8 * round(frame_size * card.frame_size[1] / card.frame_size[0] / 8))
    name = run if isinstance(run, str) else folder.resolve().name
    return World(name, run, environment or card.name, size or card.frame_size)


def _by_unique_name(worlds: Sequence[World]) -> dict[str, World]:
    """Worlds by unique name; duplicates get their folder or a number as a name."""
    by_name: dict[str, World] = {}
    for world in worlds:
        names = [world.name, str(world.run), *(f"{world.run} ({n})" for n in range(2, 1000))]
        by_name[next(name for name in names if name not in by_name)] = world
    return by_name
