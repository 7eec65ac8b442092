"""Old names of modules, keys and options: they still work, with a warning, for one release."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class RenamedWarning(FutureWarning):
    """An old name was used; it works for one more release."""


def with_new_names(
    values: Mapping[str, Any], renamed: Mapping[str, str], where: str = ""
) -> dict[str, Any]:
    """Return `values` under their new names, with a `RenamedWarning` for every old name.

    Args:
        values: values by name, from a file or a command line.
        renamed: maps old names to new ones.
        where: prefix of the names in the warning, e.g. ``"evaluation."``.
    """
    for old in values:
        if old in renamed:
            message = f"{where}{old} is now called {where}{renamed[old]}"
            warnings.warn(message, RenamedWarning, stacklevel=2)
    return {renamed.get(name, name): value for name, value in values.items()}


def without_removed(
    values: Mapping[str, Any], removed: Mapping[str, str], where: str = ""
) -> dict[str, Any]:
    """Return `values` without those that are gone, with a `RenamedWarning` for each that is set.

    Args:
        values: values by name, from a file or a command line.
        removed: what takes the place of a value that is gone, by its name.
        where: prefix of the names in the warning, e.g. ``"data."``.
    """
    for name in values:
        if values[name] and name in removed:
            warnings.warn(f"{where}{name} is gone: {removed[name]}", RenamedWarning, stacklevel=2)
    return {name: value for name, value in values.items() if name not in removed}


RENAMED = {
    f"acwm_core.{old}": f"acwm_core.{new}"
    for old, new in {
        "assembly": "model.build",
        "catalog": "plugins",
        "codec": "model.codec",
        "conditioner": "model.conditioner",
        "data.encoding": "data.latents",
        "data.episodes": "data.dataset",
        "data.manifest": "data.dataset",
        "denoiser": "model.dynamics",
        "dynamics": "model.dynamics",
        "environment": "env.environment",
        "environment_card": "env.card",
        "episode": "env.episode",
        "estimator": "env.physics",
        "evaluation.benchmark": "evaluation.protocol",
        "hooks": "plugins",
        "metric": "evaluation.metric",
        "planning.task": "env.task",
        "registry": "plugins",
        "shapes": "model.shapes",
        "statistics": "evaluation.statistics",
        "streaming": "model.stream",
        "world_model": "model.world_model",
    }.items()
}
"""New names of the modules that packages of other authors import, by old name."""


RENAMED_ATTRIBUTES = {
    "acwm_core.errors": {
        "ActionError": "ShapeError",
        "CheckpointError": "DataError",
        "OtherDatasetError": "DataError",
        "UnknownNameError": "RecipeError",
    }
}
"""New names of what such packages import from a module, by module and old name."""


def renamed_attribute(module: str, name: str) -> Any:
    """What a module has under its new name, for the `__getattr__` of the module.

    Raises:
        AttributeError: the module never had this name.
    """
    new = RENAMED_ATTRIBUTES[module].get(name)
    if new is None:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warnings.warn(f"{module}.{name} is now called {new}", RenamedWarning, stacklevel=3)
    return getattr(sys.modules[module], new)


class RenamedModules(MetaPathFinder, Loader):
    """Finds a renamed module by its old name: the same module object as by the new one."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module that has a new name."""
        if fullname == "acwm_core.planning":  # it held one of them
            return ModuleSpec(fullname, self, is_package=True)
        return ModuleSpec(fullname, self) if fullname in RENAMED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Import it by its new name, and say so."""
        if spec.name not in RENAMED:
            return None
        message = f"{spec.name} is now called {RENAMED[spec.name]}"
        warnings.warn(message, RenamedWarning, stacklevel=2)
        return importlib.import_module(RENAMED[spec.name])

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is left to do: it was imported by its new name."""


def find_renamed_modules() -> None:
    """Let the old names be imported."""
    sys.meta_path.append(RenamedModules())
