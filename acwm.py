"""`import acwm` puts every installed environment into Gymnasium's registry, as ``acwm/NAME-v0``.

`acwm.load("runs/mine")` opens a run folder, or a trained model by its name.

    import acwm, gymnasium
    env = gymnasium.make("acwm/push_cube-v0")

    env = gymnasium.make("acwm/push_cube-v0", task="place")  # with a reward: docs/tasks.md

Or in one line, `gymnasium.make("acwm:acwm/push_cube-v0")`. Everything else lives in `acwm_core`.
Registering on import is the custom since Gymnasium 1.0, which has no entry points any more; nothing
but the catalog is imported then.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from acwm_core import __version__
from acwm_core.catalog import catalog

if TYPE_CHECKING:
    from acwm_core.registry import Component
    from acwm_core.training.run import RunBundle

__all__ = ["__version__", "load", "register"]


def register() -> None:
    """Register every environment of the catalog that has no Gymnasium id yet, lazily."""
    for component in catalog().registry("environment"):
        name = f"acwm/{component.name}-v0"
        if name not in gymnasium.registry:
            # Environments truncate themselves at their card's horizon, so no TimeLimit is needed.
            gymnasium.register(id=name, entry_point=functools.partial(_make, component.name))
    for component in catalog().registry("gymnasium_environment"):
        name = f"acwm/{component.name}-v0"
        if name not in gymnasium.registry:
            many = functools.partial(_make_many, component)
            gymnasium.register(id=name, entry_point=component.create, vector_entry_point=many)


def load(name: str | Path) -> RunBundle:
    """The recipe, environment card and world model of a run folder or a trained model.

    Raises:
        AcwmError: there is none, or it cannot be read or fetched.
    """
    from acwm_core.training.run import load_run  # which imports torch

    return load_run(name)


def _make(name: str, *, task: str | None = None, **params: Any) -> Any:
    component = catalog().component("environment", name)
    if task is None:
        return component.create(**params)
    from acwm_core.planning.task import TaskEnvironment

    return TaskEnvironment(component.create(**params), component.load_task(task))


def _make_many(component: Component, *, num_envs: int, **params: Any) -> Any:
    single = component.load()
    if not hasattr(single, "vector"):
        ids = [lambda: component.create(**params)] * num_envs
        return gymnasium.vector.SyncVectorEnv(ids)
    return single.vector(num_envs=num_envs, **params)


register()
